"""Find the height of the floor: heights count from z = 0, whatever the person stands on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from bodyscan.arrays import Array
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.reconstruction.range_image import RangeImage
from bodyscan.rig.rig import Volume

REACH_MM = 60.0
"""Anything higher is an instep, or a step to stand on."""
LEVEL = 0.985
"""Cosine to the vertical, 10 degrees: only spots of a foot are as level."""
EVERY_PX = 4
FEWEST = 300
"""points, with one pixel in four along each axis: a patch of about 10 x 10 cm."""
FEWEST_PAIRS = 2


def find_floor(
    images: Sequence[RangeImage], rig_from_camera: Mapping[str, RigidTransform], volume: Volume
) -> float | None:
    """Height z of the floor, mm, rig frame.

    The median over the pairs that see level ground within the volume; None if fewer than two do.

    images: as decoded, not cleaned.
    rig_from_camera: as calibrated; a floor does not sway.
    """
    heights = [_level(image, rig_from_camera[image.pair], volume) for image in images]
    seen = [float(np.median(own)) for own in heights if len(own) >= FEWEST]
    return float(np.median(seen)) if len(seen) >= FEWEST_PAIRS else None


def _level(image: RangeImage, at: RigidTransform, volume: Volume) -> Array:
    """Heights (N,) of points that face upwards near z = 0."""
    some = image.every(EVERY_PX)
    kept = image.valid[some]
    points = at.apply(image.points[some][kept].astype(np.float64))
    up = image.normals[some][kept].astype(np.float64) @ at.rotation[2]
    low = np.abs(points[:, 2]) < REACH_MM
    inside = np.hypot(points[:, 0], points[:, 1]) < volume.radius_mm
    return np.asarray(points[low & inside & (up > LEVEL), 2])
