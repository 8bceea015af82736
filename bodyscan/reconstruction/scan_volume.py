"""Which stripes each pixel of a pair may see of the scan volume."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from bodyscan.calibration.pair import PairCalibration
from bodyscan.capture.rig import Volume
from bodyscan.capture.wanted_stripes import BLOCK_PX, WantedStripes
from bodyscan.geometry.measuring import measure
from bodyscan.geometry.transforms import RigidTransform

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

MARGIN_MM = 30.0
STEP_STRIPES = 4


def stripes_in_volume(
    pair: PairCalibration, rig_from_camera: RigidTransform, volume: Volume
) -> WantedStripes | None:
    """By blocks of pixels, the stripes that light something in the scan volume; a little more.

    The rays through the blocks' corners are followed from stripe to stripe; a block has what those
    of its own corners and of the next ones need. None, that is everything, if the pair has
    no projector, or if depth does not grow (or fall) with s all over the volume: the projector
    stands in the picture.
    """
    if pair.light is None:
        return None
    s = np.arange(0.0, pair.light.stripes + STEP_STRIPES, STEP_STRIPES).clip(0, pair.light.stripes)
    corners = (np.arange(0.0, size + BLOCK_PX, BLOCK_PX) - 0.5 for size in _size(pair))
    rays = pair.camera.rays(np.stack(np.meshgrid(*corners), axis=-1))[..., None, :]
    rays = np.broadcast_to(rays, (*rays.shape[:2], len(s), 3))
    found = measure(pair.light, rays, np.broadcast_to(s, rays.shape[:-1]))
    there = _inside(rig_from_camera.apply(rays * found.depth[..., None]), volume)
    growing = found.per_stripe[there] > 0
    if growing.any() and not growing.all():
        return None
    rising = bool(growing.all())
    depth = s if rising else -s
    near = np.where(there, depth, np.inf).min(axis=-1) - STEP_STRIPES
    far = np.where(there, depth, -np.inf).max(axis=-1) + STEP_STRIPES
    # Of 4 x 4 corners, the four in the middle being the block's own.
    around = np.ones((4, 4), np.uint8)
    near, far = cv2.erode(near, around)[1:, 1:], cv2.dilate(far, around)[1:, 1:]
    missed = near > far
    near[missed], far[missed] = np.nan, np.nan
    return WantedStripes(near.astype(np.float32), far.astype(np.float32), rising)


def _size(pair: PairCalibration) -> tuple[int, int]:
    return pair.camera.width, pair.camera.height


def _inside(points: Array, volume: Volume) -> Mask:
    """(...) points (..., 3), rig frame, in the volume or within a margin around it; NaN is not."""
    across = np.hypot(points[..., 0], points[..., 1]) < volume.radius_mm + MARGIN_MM
    height = points[..., 2]
    return across & (height > volume.bottom_mm - MARGIN_MM) & (height < volume.top_mm + MARGIN_MM)
