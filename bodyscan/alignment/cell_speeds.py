"""How fast the body's cells moved while one pair saw them, from that pair's own stripes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodyscan.alignment.body_cells import CELL_MM, BodyCells
from bodyscan.arrays import Array, Indices
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.geometry.velocity import SurfaceSpeeds


@dataclass(frozen=True, eq=False)
class CellSpeeds:
    """Normal equations of the speeds (mm/s, rig frame) that carry cells back, against their motion.

    cells: (c,).
    information: (c, 3, 3).
    gradient: (c, 3).
    shared: information (K, c, 3) that cells have in common with K errors shared by all of them,
        each of standard deviation 1.
    beside: information (K, K) and gradient (K,) of these errors.
    """

    cells: Indices
    information: Array
    gradient: Array
    shared: Array
    beside: tuple[Array, Array]

    @staticmethod
    def of(told: SurfaceSpeeds, rig_from_camera: RigidTransform, cells: BodyCells) -> CellSpeeds:
        """The speeds that a pair measured, each assigned to the cell it lies in."""
        points, facing = rig_from_camera.apply(told.points), rig_from_camera.rotate(told.facing)
        normals = -facing / np.linalg.norm(facing, axis=1, keepdims=True)
        cell = cells.find(points, normals)
        near = np.linalg.norm(points - cells.centres[cell], axis=1) < CELL_MM
        own, number = np.unique(cell[near], return_inverse=True)
        weight, facing, speed = told.sigma[near] ** -2.0, facing[near], -told.speed[near]

        def total(values: Array) -> Array:
            """Sums (c, ...) of values (n, ...)."""
            flat = values.reshape(len(values), -1).T
            sums = [np.bincount(number, column, len(own)).astype(float) for column in flat]
            return np.asarray(np.stack(sums, axis=-1).reshape(len(own), *values.shape[1:]))

        weighted, errors = weight[:, None] * facing, told.shared[near]
        return CellSpeeds(
            own,
            total(weighted[:, :, None] * facing[:, None, :]),
            total(weighted * speed[:, None]),
            np.moveaxis(total(errors[:, :, None] * weighted[:, None, :]), 1, 0),
            (np.eye(errors.shape[1]) + (errors.T * weight) @ errors, errors.T @ (weight * speed)),
        )

    def asked(self, fields: Array) -> tuple[Array, Array]:
        """Normal equations (M, M), (M,) of the rates at which fields (C, 12, M) grow."""
        own = fields[self.cells, :3]
        basis = own.reshape(-1, own.shape[2])
        shared = self.shared.reshape(len(self.shared), basis.shape[0]) @ basis
        square, pull = self.beside
        share = np.linalg.solve(square, shared)
        return (
            basis.T @ (self.information @ own).reshape(basis.shape) - shared.T @ share,
            basis.T @ self.gradient.ravel() - share.T @ pull,
        )
