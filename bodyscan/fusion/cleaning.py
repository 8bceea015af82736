"""Remove from range images whatever is not the subject, or not a surface.

Everything happens on the pixel grid, where a neighbour is one step away.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from bodyscan.arrays import Array, Bytes, Floats, Mask, find_crop, pad_crop
from bodyscan.compiled import compiled
from bodyscan.errors import ScanFailed
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.progress import map_threads
from bodyscan.reconstruction.range_image import RangeImage
from bodyscan.rig.rig import Volume

MAX_SLOPE = 5.0
"""Depth per sideways step on the steepest useful surface: tan 79 degrees."""


def clean(
    range_images: Sequence[RangeImage],
    rig_from_camera: dict[str, RigidTransform],
    volume: Volume,
    *,
    empty: Sequence[RangeImage] = (),
    smallest_patch_mm2: float = 150.0,
) -> list[RangeImage]:
    """Remove from range images whatever shows no part of the subject.

    empty: range images of the rig without a subject, of some or all pairs.
    smallest_patch_mm2: smaller disconnected patches are removed.

    Removed are: everything outside the scan volume, what `empty` shows, flying pixels, grazing
    surfaces, narrow dark gaps (see `find_dark_gaps`), and small patches.
    """
    background = {image.pair: image for image in empty}

    def clean_one(image: RangeImage) -> RangeImage:
        kept = find_inside(image, rig_from_camera[image.pair], volume)
        if image.pair in background:
            kept &= find_foreground(image, background[image.pair])
        box = find_crop(kept)
        if box is not None:
            kept[box] &= ~find_dark_gaps(image.colours[box])
        if box is not None and kept.any():
            depth = np.where(kept[box], image.points[box][..., 2], np.float32(np.nan))
            pixel_mm = float(np.median(depth[kept[box]])) / image.camera.alpha
            solid = drop_flying_pixels(depth, MAX_SLOPE * pixel_mm)
            kept[box] = drop_speckles(solid, MAX_SLOPE * pixel_mm, smallest_patch_mm2 / pixel_mm**2)
        return apply_mask(image, kept)

    return map_threads(clean_one, range_images)


def require_subject(cleaned: Sequence[RangeImage]) -> list[RangeImage]:
    """The images that show some of the subject. Raises ScanFailed if none does."""
    valid = [image for image in cleaned if image.valid.any()]
    if not valid:
        raise ScanFailed(
            "nobody is in the scan volume",
            remedy="look at the lit images; check `volume` in the calibration's calibration.json, that "
            "square_mm is in mm, and that a folder given with --empty shows the rig without anybody",
        )
    return valid


def apply_mask(image: RangeImage, kept: Mask) -> RangeImage:
    """The range image with nothing measured where `kept` (h, w) is false."""
    return replace(image, sigma_mm=np.where(kept, image.sigma_mm, np.float32(np.nan)))


def cut_to_volume(image: RangeImage, rig_from_camera: RigidTransform, volume: Volume) -> RangeImage:
    """Crop to what lies inside the scan volume; cleaning leaves nothing else."""
    box = find_crop(find_inside(image, rig_from_camera, volume)) or (slice(0, 1), slice(0, 1))
    return image.crop(pad_crop(box, 8))  # farther than any later window reaches beyond a rim


def find_inside(image: RangeImage, rig_from_camera: RigidTransform, volume: Volume) -> Mask:
    """(h, w): where a point was measured inside the upright cylinder of the scan volume."""
    inside = np.isfinite(image.sigma_mm)
    limits = volume.radius_mm, volume.bottom_mm, volume.top_mm
    _drop_outside(image.points, rig_from_camera.matrix[:3], limits, inside)
    return inside


@compiled
def _drop_outside(
    points: Floats, matrix: Array, limits: tuple[float, float, float], kept: Mask
) -> None:
    """Unset kept pixels (h, w) whose points lie outside an upright cylinder: radius, bottom, top."""
    radius, bottom, top = limits
    for row in range(kept.shape[0]):
        for column in range(kept.shape[1]):
            if kept[row, column]:
                a, b, c = points[row, column]
                x = matrix[0, 0] * a + matrix[0, 1] * b + matrix[0, 2] * c + matrix[0, 3]
                y = matrix[1, 0] * a + matrix[1, 1] * b + matrix[1, 2] * c + matrix[1, 3]
                z = matrix[2, 0] * a + matrix[2, 1] * b + matrix[2, 2] * c + matrix[2, 3]
                kept[row, column] = x * x + y * y < radius * radius and bottom < z < top


def find_foreground(image: RangeImage, empty: RangeImage) -> Mask:
    """(h, w): where a point lies 4 mm or more before the background around its pixel."""
    window = np.ones((3, 3), np.uint8)
    far = np.where(empty.open_depth > 0.0, empty.open_depth, np.float32(np.inf))
    with np.errstate(invalid="ignore"):
        return image.points[..., 2] < cv2.erode(far, window)[image.part] - 4.0


@compiled
def drop_flying_pixels(depth: Floats, step_mm: float, supporters: int = 13) -> Floats:
    """Depth (h, w) of pixels that enough neighbours agree with to `step_mm` per step; else NaN.

    At a straight rim a pixel has 14 of its 24 neighbours; a flying one has few. A second pass no
    longer counts what the first removed.
    """
    (height, width), steps = depth.shape, np.empty((5, 5), np.float32)
    for down in range(5):
        for right in range(5):
            steps[down, right] = step_mm * np.sqrt((down - 2) ** 2 + (right - 2) ** 2)
    for _ in range(2):
        kept = np.full((height, width), np.float32(np.nan))
        for row in range(height):
            for column in range(width):
                here, count = depth[row, column], 0
                if np.isnan(here):
                    continue
                for r in range(max(row - 2, 0), min(row + 3, height)):
                    for c in range(max(column - 2, 0), min(column + 3, width)):
                        count += abs(depth[r, c] - here) < steps[r - row + 2, c - column + 2]
                if count >= supporters:
                    kept[row, column] = here
        depth = kept
    return depth


def drop_speckles(depth: Floats, step_mm: float, smallest_px: float) -> Mask:
    """(h, w): pixels in connected patches of at least `smallest_px`, split at jumps in depth."""
    quantum_mm = 0.25  # of 16-bit integers: 8 m
    quanta = np.clip(np.nan_to_num(depth) / quantum_mm, 0, 32767).astype(np.int16)
    patches, _ = cv2.filterSpeckles(quanta, 0, int(smallest_px), step_mm / quantum_mm)
    return patches > 0


def find_dark_gaps(grey: Bytes) -> Mask:
    """(height, width): pixels in a narrow dark gap of an image (height, width), or at its rim.

    Between two toes a camera sees the blur of bright skin on both sides, measured as a bridge. A
    morphological closing fills what is narrower than its window; dark and wide things stay.
    """
    # 7 pixels: the gap and half of its slopes, several times the blur.
    window = np.ones((7, 7), np.uint8)
    around = cv2.morphologyEx(grey, cv2.MORPH_CLOSE, window).astype(np.float32)
    # Less than 30 grey levels may be noise on a dark surface.
    dark = (around > 2.0 * grey) & (around >= grey + np.float32(30))
    return cv2.dilate(dark.view(np.uint8), np.ones((3, 3), np.uint8)).view(bool)
