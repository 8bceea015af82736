"""How fast the body's cells moved while one pair saw them, as that pair's own stripes tell it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodyscan.alignment.body_cells import BodyCells
from bodyscan.arrays import Array, Indices
from bodyscan.geometry.transforms import RigidTransform, adjoint, twist_jacobian
from bodyscan.geometry.velocity import SpeedField
from bodyscan.reconstruction.range_image import RangeImage

SLACK = np.array([1e-3, 1e-3, 1e-3, 0.5, 0.5, 0.5])
"""rad/s and mm/s: how far the rigid part of what is not rigid depends on what was looked at."""
LEAST_FACING = 0.3
ARM_MM = 300.0  # at which a turn of what one pair saw counts as much as its shift
LEAST_SHOWN = 1e-3
"""of what the cells show of a freedom on average; how a ball turns nobody sees"""


@dataclass(frozen=True, eq=False)
class CellSpeeds:
    """Of speeds along their normals (c, 3) of cells (c,), against the body's own, as they carry it
    back: `combined` (r, c) of them are `speeds` (r,), each with a standard deviation of 1."""

    cells: Indices
    normals: Array
    combined: Array
    speeds: Array

    @staticmethod
    def of(
        image: RangeImage, rig_from_camera: RigidTransform, cells: BodyCells, seen: Indices
    ) -> CellSpeeds:
        """What a pair's velocity, which is that of a rigid body, says of the cells seen (c,): the
        rigid motion that comes nearest to theirs is the one it tells."""
        velocity = image.velocity
        assert velocity is not None
        camera_from_rig = rig_from_camera.inverse()
        points = camera_from_rig.apply(cells.centres[seen])
        normals = camera_from_rig.rotate(cells.normals[seen])
        facing = -np.sum(normals * points, axis=1) > LEAST_FACING * np.linalg.norm(points, axis=1)
        seen, points, normals = seen[facing], points[facing], normals[facing]
        # About the cells' middle turns and shifts are told apart.
        about = adjoint(RigidTransform(np.eye(3), points.mean(axis=0)))
        levers = np.einsum("nc,nck->nk", normals, twist_jacobian(points - points.mean(axis=0)))
        levers[:, :3] /= ARM_MM
        square = levers.T @ levers
        held = square + LEAST_SHOWN * np.trace(square) / 6.0 * np.eye(6)
        nearest = about @ (np.linalg.solve(held, levers.T) / np.repeat([ARM_MM, 1.0], 3)[:, None])
        across = np.sum(normals * points, axis=1) / points[:, 2]
        twist = velocity.twist + nearest @ (_beside_rigid(velocity.field, image, points) * across)
        slack = about @ np.diag(SLACK**2) @ about.T
        whiten = np.linalg.inv(np.linalg.cholesky(velocity.covariance + slack))
        return CellSpeeds(seen, cells.normals[seen], whiten @ nearest, -(whiten @ twist))


def _beside_rigid(field: SpeedField | None, image: RangeImage, points: Array) -> Array:
    """(n,) speeds in z beside the rigid ones at points (n, 3) of the camera's frame."""
    if field is None or min(field.speed.shape) < 2:
        return np.zeros(len(points))
    from scipy.interpolate import RegularGridInterpolator  # 0.2 s, and few scans need it

    pixels = image.camera.project(points)[:, ::-1]
    places = field.rows, field.columns
    found = RegularGridInterpolator(places, field.speed, bounds_error=False)(pixels)
    return np.nan_to_num(found)
