"""Limits on the stripes that each pixel of a pair may see in the scan volume."""

from __future__ import annotations

import cv2
import numpy as np

from bodyscan.arrays import Array
from bodyscan.calibration.pair import PairCalibration
from bodyscan.compiled import compiled
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.light_sheets import intersect_rays
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.rig.rig import Volume
from bodyscan.stripes.stripe_limits import StripeLimits

MARGIN_STRIPES = 1.5  # runs of boundaries need a neighbour, and limits are linear between corners
FAR_MM = 1e5


def find_stripes_in_volume(
    pair: PairCalibration, rig_from_camera: RigidTransform, volume: Volume
) -> StripeLimits | None:
    """Find the stripes that light what stands in the scan volume, or lies next to it at its bottom.

    None, meaning all, if the pair has no projector, or if depth is not monotonic in s all over the
    volume: then the projector is in the image.
    """
    if pair.sheets is None:
        return None
    block_px = max(1, round(pair.camera.width / 40))
    rays = _compute_corner_rays(pair.camera, block_px)
    near, far = compute_volume_interval(rays, rig_from_camera, volume, raised_mm=0.0)
    standing = compute_volume_interval(rays, rig_from_camera, volume, raised_mm=25.0)[1]
    standing = np.maximum(np.minimum(standing, far), near)
    count = round(pair.sheets.stripes / 8) + 1
    s = np.linspace(0.0, pair.sheets.stripes, count)
    repeated = np.broadcast_to(rays[:, :, None], (*rays.shape[:2], count, 3))
    found = intersect_rays(pair.sheets, repeated, np.broadcast_to(s, repeated.shape[:-1]))
    within = (found.depth > near[..., None]) & (found.depth < far[..., None])
    growing = found.per_stripe[within if within.any() else np.isfinite(found.per_stripe)] > 0
    if growing.any() != growing.all():
        return None
    rising = bool(growing.any())
    order = slice(None) if rising else slice(None, None, -1)
    inverse = np.ascontiguousarray(1.0 / found.depth[..., order])
    depth = s if rising else -s[order]
    limits = np.full((3, *near.shape), np.nan)
    for limit, z in zip(limits, (near, far, standing), strict=True):
        _interpolate_stripes(inverse, depth, 1.0 / z, limit)
    near_by, far_by = _measure_nonlinearity(rays, rig_from_camera, volume, (near, far), limits)
    limits += np.stack([-near_by, far_by, np.zeros_like(far)])
    limits += np.array([-MARGIN_STRIPES, MARGIN_STRIPES, 0.0])[:, None, None]
    unknown = np.array([-1e6, 1e6, 1e6])[:, None, None]  # all stripes
    limits = np.where(np.isnan(limits), unknown, limits).astype(np.float32)
    # Points in the lowest 25 mm are wanted only within 60 mm of what stands, here in pixels at the
    # volume's middle as the camera sees it; the camera may be at the rig's origin.
    visible = near < far
    middle_mm = 0.5 * float(np.median((near + far)[visible])) if visible.any() else FAR_MM
    around_px = 60.0 * pair.camera.alpha / middle_mm
    return StripeLimits(limits[0], limits[1], limits[2], rising, block_px, around_px=around_px)


def compute_volume_interval(
    rays: Array, rig_from_camera: RigidTransform, volume: Volume, *, raised_mm: float
) -> tuple[Array, Array]:
    """Depths z (...) mm at which rays (..., 3), camera frame, z = 1, enter and leave the volume.

    The volume is taken 30 mm wider and higher, with its bottom raised. A ray that misses it
    leaves before it enters, or does both where it is nearest to the axis: depths are smooth.
    """
    direction, start = rig_from_camera.rotate(rays), rig_from_camera.translation
    radius = volume.radius_mm + 30.0
    level2 = np.sum(direction[..., :2] ** 2, axis=-1).clip(1e-12)
    nearest = -(direction[..., :2] @ start[:2]) / level2
    distance2 = np.sum((start[:2] + nearest[..., None] * direction[..., :2]) ** 2, axis=-1)
    half = np.sqrt((radius**2 - distance2).clip(0.0) / level2)
    upward = np.where(np.abs(direction[..., 2]) < 1e-9, 1e-9, direction[..., 2])
    ends = volume.bottom_mm + raised_mm, volume.top_mm + 30.0
    floor, ceiling = ((height - start[2]) / upward for height in ends)
    enter = np.maximum(nearest - half, np.minimum(floor, ceiling))
    leave = np.minimum(nearest + half, np.maximum(floor, ceiling))
    # Behind the camera, a ray leaves before it enters.
    return enter.clip(50.0, FAR_MM), leave.clip(25.0, FAR_MM)


def _measure_nonlinearity(
    rays: Array,
    rig_from_camera: RigidTransform,
    volume: Volume,
    ends: tuple[Array, Array],
    limits: Array,
) -> tuple[Array, Array]:
    """Stripes by which near and far limits (rows, columns) at the corners of blocks must be widened.

    ends: depths at which the rays enter and leave.

    Limits are interpolated linearly between corners, but have a kink where the volume's wall meets
    its bottom inside a block. The margin covers that, except for a camera so low that it looks along
    the bottom. Inverse depth is nearly linear in s: a block's middle shows at least half of it.
    """
    near, far = ends
    stripes = np.where(near < far, limits[1] - limits[0], 0.0)
    per_inverse = np.nan_to_num(stripes / np.where(near < far, 1.0 / near - 1.0 / far, np.inf))
    middle = compute_volume_interval(_average_blocks(rays), rig_from_camera, volume, raised_mm=0.0)
    kinks = (
        1.0 / middle[0] - _average_blocks(1.0 / near),
        _average_blocks(1.0 / far) - 1.0 / middle[1],
    )
    window = np.ones((3, 3), np.uint8)
    largest = cv2.dilate(per_inverse, window)
    widths = (2.0 * largest * cv2.dilate(np.pad(k, 1), window[:2, :2])[1:, 1:] for k in kinks)
    near_by, far_by = (np.where(width > MARGIN_STRIPES, width, 0.0) for width in widths)
    return near_by, far_by


def _average_blocks(corners: Array) -> Array:
    """Mean of each block's four corners, (rows - 1, columns - 1, ...)."""
    rows = corners[1:] + corners[:-1]
    return 0.25 * (rows[:, 1:] + rows[:, :-1])


def _compute_corner_rays(camera: Camera, block_px: int) -> Array:
    """Rays (rows, columns, 3) through the corners of blocks of pixels that cover the image."""
    sizes = camera.width, camera.height
    edges = (np.arange(0.0, size + block_px, block_px) - 0.5 for size in sizes)
    return camera.rays(np.stack(np.meshgrid(*edges), axis=-1))


@compiled
def _interpolate_stripes(inverse: Array, s: Array, target: Array, found: Array) -> None:
    """Interpolate s (rows, columns) at which rays have the inverse depths `target`.

    inverse: depths of the sheets at s (K,), falling, or NaN, (rows, columns, K); at least two.

    Linear between sheets and past the last, as inverse depth along a ray nearly is.
    """
    for row in range(target.shape[0]):
        for column in range(target.shape[1]):
            one, other = -1, -1
            for k in range(s.size):
                here = inverse[row, column, k]
                if np.isnan(here):
                    continue
                one, other = other, k
                if one >= 0 and here <= target[row, column]:
                    break
            if one >= 0:
                low, high = inverse[row, column, one], inverse[row, column, other]
                share = (target[row, column] - low) / (high - low)
                found[row, column] = s[one] + share * (s[other] - s[one])
