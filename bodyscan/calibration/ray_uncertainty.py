"""How well camera rays are known where boards did not reach."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bodyscan.arrays import Array, Mask
from bodyscan.calibration.board_views import PlanarView
from bodyscan.calibration.camera import CameraFit
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.transforms import twist_jacobian
from bodyscan.geometry.uncertainty import RayUncertainty, node_pixels

MOST_CORNERS = 3000


def ray_uncertainty(
    chosen: Camera, richest: CameraFit, views: Sequence[PlanarView]
) -> RayUncertainty:
    """Uncertainty of the rays of the camera `chosen`.

    richest: a fit to the same views with the richest lens that held-out boards cannot tell from the
        chosen one, or the chosen fit itself.

    Its covariance shows what the boards leave open, even far from them, where the chosen lens would
    promise what nobody saw; and the chosen lens may be wrong by as much as the two differ. A motion
    of the camera, as seen at its boards, is removed from both: it belongs to the pose and is in the
    pose's covariance.
    """
    camera = richest.camera
    corners = np.concatenate(
        [pose.apply(view.points) for pose, view in zip(richest.poses, views, strict=True)]
    )
    corners = corners[:: -(-len(corners) // MOST_CORNERS)]
    pixels = node_pixels(camera.width, camera.height)
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
    """Changes of pixels at points (N, 3), camera frame.

    (N, 2, P + 1): by the parameters of `camera`, and its difference from `chosen`.
    (N, 2, 6): by a motion of the points.
    """
    by_parameter, by_point = camera.jacobians(points)
    apart = camera.project(points) - chosen.project(points)
    return (
        np.concatenate([by_parameter, apart[..., None]], axis=2),
        by_point @ twist_jacobian(points),
    )


def _flat(by: Array) -> Array:
    return by.reshape(-1, by.shape[2])


def _filled(values: Array, shown: Mask) -> Array:
    """Values on all nodes; nodes without rays, where the lens folds, get the largest value."""
    every = np.full(shown.shape, values.max(initial=0.0))
    every[shown] = values
    return every
