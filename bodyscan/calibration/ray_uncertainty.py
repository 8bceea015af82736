"""What boards in one part of a picture say about its other parts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bodyscan.arrays import Array, Mask
from bodyscan.calibration.board_views import PlanarView
from bodyscan.calibration.camera import CameraFit
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.ray_uncertainty import RayUncertainty, nodes
from bodyscan.geometry.transforms import twist_jacobian

MOST_CORNERS = 3000


def ray_uncertainty(
    chosen: Camera, richest: CameraFit, views: Sequence[PlanarView]
) -> RayUncertainty:
    """Of the camera `chosen`, its boards' views fitted as well by the lens of `richest`.

    richest: with the richest lens that held-out boards cannot tell from the chosen one; or just that.
    Its covariance says what the boards leave open, far from them as well, where the chosen lens
    would promise what nobody saw; and by as much as it differs from the chosen lens, that may be
    wrong. A motion of the camera, as seen at its boards, is left out of both: it is the pose's, and
    in the pose's covariance.
    """
    camera = richest.camera
    corners = np.concatenate(
        [pose.apply(view.points) for pose, view in zip(richest.poses, views, strict=True)]
    )
    corners = corners[:: -(-len(corners) // MOST_CORNERS)]
    pixels = nodes(camera.width, camera.height)
    rays = chosen.rays(pixels)
    shown: Mask = np.asarray(np.isfinite(rays).all(axis=-1))
    points = rays[shown] * np.median(corners[:, 2])
    there, here = _changes(chosen, camera, points), _changes(chosen, camera, corners)
    motion = np.linalg.lstsq(_flat(here[1]), _flat(here[0]), rcond=None)[0]
    left = there[0] - there[1] @ motion
    by_parameter, apart = left[..., :-1], left[..., -1]
    noise = np.einsum("npi,ij,npj->n", by_parameter, richest.covariance, by_parameter) / 2.0
    lens = np.sum(apart**2, axis=1) / 2.0
    return RayUncertainty(*(_filled(np.sqrt(np.maximum(one, 0.0)), shown) for one in (noise, lens)))


def _changes(chosen: Camera, camera: Camera, points: Array) -> tuple[Array, Array]:
    """(N, 2, P + 1): by the parameters of `camera`, and how far it shows the points (N, 3) from where
    `chosen` does; (N, 2, 6): by a motion of the points."""
    by_parameter, by_point = camera.jacobians(points)
    apart = camera.project(points) - chosen.project(points)
    return (
        np.concatenate([by_parameter, apart[..., None]], axis=2),
        by_point @ twist_jacobian(points),
    )


def _flat(by: Array) -> Array:
    return by.reshape(-1, by.shape[2])


def _filled(values: Array, shown: Mask) -> Array:
    """On all nodes; where the lens folds, which has no rays, as the worst that has."""
    every = np.full(shown.shape, values.max(initial=0.0))
    every[shown] = values
    return every
