"""A point from the rays of several cameras."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bodyscan.arrays import Array, Mask
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.transforms import RigidTransform

STEPS = 5


def triangulate(
    cameras: Sequence[Camera], camera_from_rig: Sequence[RigidTransform], pixels: Array
) -> Array:
    """Points (N, 3), rig frame, mm, from pixels (C, N, 2) in C cameras; NaN pixels: not seen.

    Nearest point to all rays, then Gauss-Newton on the reprojection error in px. A point seen by
    fewer than two cameras is NaN.
    """
    seen = np.isfinite(pixels[..., 0])
    points = _nearest_to_rays(cameras, camera_from_rig, pixels, seen)
    enough = seen.sum(axis=0) >= 2
    for _ in range(STEPS):
        normal, right = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3))
        for camera, transform, seen_at, here in zip(
            cameras, camera_from_rig, pixels, seen & enough, strict=True
        ):
            jacobian, residual = _linearized(camera, transform, points[here], seen_at[here])
            normal[here] += np.einsum("nij,nik->njk", jacobian, jacobian)
            right[here] += np.einsum("nij,ni->nj", jacobian, residual)
        points[enough] -= np.linalg.solve(normal[enough], right[enough][..., None])[..., 0]
    points[~enough] = np.nan
    return points


def _nearest_to_rays(
    cameras: Sequence[Camera],
    camera_from_rig: Sequence[RigidTransform],
    pixels: Array,
    seen: Mask,
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
    few = seen.sum(axis=0) < 2
    normal[few] = np.eye(3)
    return np.asarray(np.linalg.solve(normal, right[..., None])[..., 0], np.float64)


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
