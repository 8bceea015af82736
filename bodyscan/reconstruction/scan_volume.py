"""Which stripes each pixel of a pair may see in the scan volume."""

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

BLOCKS_ACROSS = 40
STEP_STRIPES = 8
MARGIN_STRIPES = 1.5  # runs of boundaries need a neighbour, and limits are linear between corners
MARGIN_MM = 30.0  # beside the cylinder and above it
LAYER_MM, AROUND_MM = 25.0, 60.0  # lower points are wanted only this close to what stands
NEAREST_MM, FARTHEST_MM = 50.0, 1e5
ANYTHING = 1e6  # more stripes than there are


def stripes_in_volume(
    pair: PairCalibration, rig_from_camera: RigidTransform, volume: Volume
) -> StripeLimits | None:
    """The stripes that light whatever stands in the scan volume, or lies beside it at its bottom.

    None, meaning all, if the pair has no projector, or if depth does not grow (or fall) with s all
    over the volume: then the projector stands in the image.
    """
    if pair.sheets is None:
        return None
    block_px = max(1, round(pair.camera.width / BLOCKS_ACROSS))
    rays = _corner_rays(pair.camera, block_px)
    near, far = volume_interval(rays, rig_from_camera, volume, raised_mm=0.0)
    standing = volume_interval(rays, rig_from_camera, volume, raised_mm=LAYER_MM)[1]
    standing = np.maximum(np.minimum(standing, far), near)
    count = round(pair.sheets.stripes / STEP_STRIPES) + 1
    s = np.linspace(0.0, pair.sheets.stripes, count)
    along = np.broadcast_to(rays[:, :, None], (*rays.shape[:2], count, 3))
    found = intersect_rays(pair.sheets, along, np.broadcast_to(s, along.shape[:-1]))
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
        _reach(inverse, depth, 1.0 / z, limit)
    near_by, far_by = _bulges(rays, rig_from_camera, volume, (near, far), limits)
    limits += np.stack([-near_by, far_by, np.zeros_like(far)])
    limits += np.array([-MARGIN_STRIPES, MARGIN_STRIPES, 0.0])[:, None, None]
    unknown = np.array([-ANYTHING, ANYTHING, ANYTHING])[:, None, None]
    limits = np.where(np.isnan(limits), unknown, limits).astype(np.float32)
    # At the middle of the volume as the camera sees it; the camera may stand at the rig's origin.
    seen = near < far
    middle_mm = 0.5 * float(np.median((near + far)[seen])) if seen.any() else FARTHEST_MM
    around_px = AROUND_MM * pair.camera.alpha / middle_mm
    return StripeLimits(limits[0], limits[1], limits[2], rising, block_px, around_px=around_px)


def volume_interval(
    rays: Array, rig_from_camera: RigidTransform, volume: Volume, *, raised_mm: float
) -> tuple[Array, Array]:
    """Depths z (...) mm at which rays (..., 3), camera frame, z = 1, enter and leave the volume.

    The volume is taken a little wider and higher, with its bottom raised. A ray that misses it
    leaves before it enters, or does both where it is nearest to the axis, so that depths are smooth
    across rays.
    """
    ahead, start = rig_from_camera.rotate(rays), rig_from_camera.translation
    radius = volume.radius_mm + MARGIN_MM
    flat = np.sum(ahead[..., :2] ** 2, axis=-1).clip(1e-12)
    nearest = -(ahead[..., :2] @ start[:2]) / flat
    beside2 = np.sum((start[:2] + nearest[..., None] * ahead[..., :2]) ** 2, axis=-1)
    half = np.sqrt((radius**2 - beside2).clip(0.0) / flat)
    upward = np.where(np.abs(ahead[..., 2]) < 1e-9, 1e-9, ahead[..., 2])
    ends = volume.bottom_mm + raised_mm, volume.top_mm + MARGIN_MM
    floor, ceiling = ((height - start[2]) / upward for height in ends)
    enter = np.maximum(nearest - half, np.minimum(floor, ceiling))
    leave = np.minimum(nearest + half, np.maximum(floor, ceiling))
    # Behind the camera, a ray leaves before it enters.
    return enter.clip(NEAREST_MM, FARTHEST_MM), leave.clip(NEAREST_MM / 2.0, FARTHEST_MM)


def _bulges(
    rays: Array,
    rig_from_camera: RigidTransform,
    volume: Volume,
    ends: tuple[Array, Array],
    limits: Array,
) -> tuple[Array, Array]:
    """Stripes by which near and far (rows, columns) at the corners of blocks must be widened.

    ends: depths at which the rays enter and leave.

    Limits are linear between corners, but bend where the volume's wall gives way to its bottom
    inside a block. The margin covers that, except for a camera so low that it looks along the
    bottom. The middle of a block, where inverse depth is nearly linear in s, shows at least half of
    the bend.
    """
    near, far = ends
    stripes = np.where(near < far, limits[1] - limits[0], 0.0)
    per_inverse = np.nan_to_num(stripes / np.where(near < far, 1.0 / near - 1.0 / far, np.inf))
    middle = volume_interval(_block_means(rays), rig_from_camera, volume, raised_mm=0.0)
    bent = 1.0 / middle[0] - _block_means(1.0 / near), _block_means(1.0 / far) - 1.0 / middle[1]
    around = np.ones((3, 3), np.uint8)
    most = cv2.dilate(per_inverse, around)
    grown = (2.0 * most * cv2.dilate(np.pad(one, 1), around[:2, :2])[1:, 1:] for one in bent)
    near_by, far_by = (np.where(by > MARGIN_STRIPES, by, 0.0) for by in grown)
    return near_by, far_by


def _block_means(corners: Array) -> Array:
    """Mean of each block's four corners, (rows - 1, columns - 1, ...)."""
    rows = corners[1:] + corners[:-1]
    return 0.25 * (rows[:, 1:] + rows[:, :-1])


def _corner_rays(camera: Camera, block_px: int) -> Array:
    """Rays (rows, columns, 3) through the corners of blocks of pixels that cover the image."""
    sizes = camera.width, camera.height
    edges = (np.arange(0.0, size + block_px, block_px) - 0.5 for size in sizes)
    return camera.rays(np.stack(np.meshgrid(*edges), axis=-1))


@compiled
def _reach(inverse: Array, s: Array, wanted: Array, found: Array) -> None:
    """Set found (rows, columns): s at which rays reach the inverse depths `wanted`.

    inverse: of the sheets at s (K,), falling, or NaN, (rows, columns, K); at least two are needed.

    A sheet's inverse depth along a ray is nearly linear in s, and is taken to be so between the
    sheets and past the last.
    """
    for row in range(wanted.shape[0]):
        for column in range(wanted.shape[1]):
            one, other = -1, -1
            for k in range(s.size):
                here = inverse[row, column, k]
                if np.isnan(here):
                    continue
                one, other = other, k
                if one >= 0 and here <= wanted[row, column]:
                    break
            if one >= 0:
                low, high = inverse[row, column, one], inverse[row, column, other]
                share = (wanted[row, column] - low) / (high - low)
                found[row, column] = s[one] + share * (s[other] - s[one])
