"""The height of the floor: heights count from z = 0, whatever the person stands on."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from bodyscan.arrays import Array
from bodyscan.fusion.verdict.evidence import Finding, ScanEvidence
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.reconstruction.range_image import RangeImage
from bodyscan.rig.rig import Volume


def find_floor(
    images: Sequence[RangeImage], rig_from_camera: Mapping[str, RigidTransform], volume: Volume
) -> float | None:
    """Height z of the floor, mm, rig frame.

    The median over the pairs that see level ground within the volume; None if fewer than two do.

    images: as decoded, not cleaned.
    rig_from_camera: as calibrated; a floor does not sway.
    """
    heights = [_floor_heights(image, rig_from_camera[image.pair], volume) for image in images]
    # 300 points, of one pixel in 16, are a patch of about 10 x 10 cm.
    medians = [float(np.median(some)) for some in heights if len(some) >= 300]
    return float(np.median(medians)) if len(medians) >= 2 else None


def _floor_heights(image: RangeImage, rig_from_camera: RigidTransform, volume: Volume) -> Array:
    """Heights (N,) of points that face upwards near z = 0, of one pixel in 4 along each axis."""
    some = image.subsample(4)
    valid = image.valid[some]
    points = rig_from_camera.apply(image.points[some][valid].astype(np.float64))
    upward = image.normals[some][valid].astype(np.float64) @ rig_from_camera.rotation[2]
    low = np.abs(points[:, 2]) < 60.0  # higher is an instep, or a step to stand on
    inside = np.hypot(points[:, 0], points[:, 1]) < volume.radius_mm
    level = upward > 0.985  # within 10 degrees: only spots of a foot are as level
    return np.asarray(points[low & inside & level, 2])


def check_floor(scan: ScanEvidence) -> Iterator[Finding]:
    """A floor farther from z = 0 than the 4 mm that ISO 20685-1 allows for stature.

    If poles were aligned, perhaps to others that moved, nothing is known of the heights.
    """
    floor_mm = scan.images.floor_mm
    if floor_mm is None or abs(floor_mm) <= 4.0:
        return
    yield (
        "repeat" if scan.together and scan.together.displaced else "usable",
        f"the floor is at {floor_mm:.0f} mm, not at 0: the stature is wrong by as much, and girths are "
        f"taken {abs(floor_mm):.0f} mm too {'low' if floor_mm > 0.0 else 'high'}. Possible causes: "
        "poles were lifted or lowered since the calibration; `rig_frame` is that of another floor; the "
        "person stands on something",
    )
