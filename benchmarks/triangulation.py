"""A point from the rays of several cameras."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bodyscan.arrays import Array, Mask
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.least_squares import StackedEquations, minimize_each
from bodyscan.geometry.linear_gaussian import solve_scaled
from bodyscan.geometry.transforms import RigidTransform

STEPS = 5
LEAST_PX = 1e-4  # no corner is found more precisely


def triangulate(
    cameras: Sequence[Camera], camera_from_rig: Sequence[RigidTransform], pixels: Array
) -> Array:
    """Points (N, 3), rig frame, mm, from pixels (C, N, 2) in C cameras; NaN pixels: not seen.

    Nearest point to all rays, then least squares on the reprojection error in px. A point seen by
    fewer than two cameras is NaN.
    """
    seen = np.isfinite(pixels[..., 0])
    points = np.full((pixels.shape[1], 3), np.nan)
    enough = seen.sum(axis=0) >= 2
    seen, pixels = seen[:, enough], pixels[:, enough]
    start = _nearest_to_rays(cameras, camera_from_rig, pixels, seen)
    points[enough] = minimize_each(
        start,
        lambda points: _form_equations(cameras, camera_from_rig, pixels, seen, points),
        steps=STEPS,
        damping=0.0,
        min_sigma=LEAST_PX,
    ).state
    return points


def _form_equations(
    cameras: Sequence[Camera],
    camera_from_rig: Sequence[RigidTransform],
    pixels: Array,
    seen: Mask,
    points: Array,
) -> StackedEquations:
    """Equations of points (N, 3), one camera at a time: most points are seen by few of them."""
    normal, gradient = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3))
    cost = np.zeros(len(points))
    for camera, transform, seen_at, here in zip(
        cameras, camera_from_rig, pixels, seen, strict=True
    ):
        jacobian, residual = _linearized(camera, transform, points[here], seen_at[here])
        normal[here] += np.einsum("nij,nik->njk", jacobian, jacobian)
        gradient[here] += np.einsum("nij,ni->nj", jacobian, residual)
        cost[here] += np.sum(residual**2, axis=1)
    return StackedEquations(normal, gradient, cost, np.maximum(2.0 * seen.sum(axis=0) - 3.0, 1.0))


def _nearest_to_rays(
    cameras: Sequence[Camera], camera_from_rig: Sequence[RigidTransform], pixels: Array, seen: Mask
) -> Array:
    normal, right = np.zeros((pixels.shape[1], 3, 3)), np.zeros((pixels.shape[1], 3))
    for camera, transform, seen_at, here in zip(
        cameras, camera_from_rig, pixels, seen, strict=True
    ):
        rig_from_camera = transform.inverse()
        rays = rig_from_camera.rotate(camera.rays(seen_at[here]))
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
        normal[here] += across
        right[here] += across @ rig_from_camera.translation
    return solve_scaled(normal, right)


def _linearized(
    camera: Camera, camera_from_rig: RigidTransform, points: Array, pixels: Array
) -> tuple[Array, Array]:
    """d(pixels)/d(points) (N, 2, 3) by central differences, and residuals (N, 2) px."""
    step = 0.01
    shifts = step * np.eye(3)
    moved = camera.project(
        camera_from_rig.apply(points[:, None, None] + np.stack([shifts, -shifts]))
    )
    jacobian = (moved[:, 0] - moved[:, 1]) / (2.0 * step)
    residual = camera.project(camera_from_rig.apply(points)) - pixels
    return np.swapaxes(jacobian, 1, 2), residual
