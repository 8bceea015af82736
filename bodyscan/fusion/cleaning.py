"""What is not the subject, or not a surface, leaves the range images.

Everything happens on the pixel grid, where a neighbour is one step away.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from bodyscan.capture.rig import Volume
from bodyscan.errors import ScanFailed
from bodyscan.fusion.grid import Floats, carried, crop_of
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.reconstruction.range_image import RangeImage

Mask = NDArray[np.bool_]

STEEPEST = 5.0  # depth per sideways step on a surface still worth having: tan 79 degrees
# Half of the 24 neighbours in a square window (rows, columns): the others are their mirror images.
HALF_WINDOW = [(r, c) for r in range(3) for c in range(-2, 3) if r > 0 or c > 0]
BACKGROUND_MM = 4.0  # a subject stands out from the background by more than this
QUANTUM_MM = 0.25  # cv2.filterSpeckles works on 16-bit integers: +-8 m in steps of this


def clean(
    range_images: Sequence[RangeImage],
    rig_from_camera: dict[str, RigidTransform],
    volume: Volume,
    *,
    empty: Sequence[RangeImage] = (),
    smallest_patch_mm2: float = 150.0,
    workers: int = 2,
) -> list[RangeImage]:
    """The same range images with NaN where a pixel shows no part of the subject.

    Cut away are: what lies outside the scan volume (floor, walls), what the rig sees without a
    subject (`empty`: range images of that, of some or all pairs), flying pixels at silhouettes,
    grazing surfaces, and disconnected patches smaller than `smallest_patch_mm2`.
    """
    nobody = {image.pair: image for image in empty}

    def one(image: RangeImage) -> RangeImage:
        kept = inside(image, rig_from_camera[image.pair], volume)
        if image.pair in nobody:
            kept &= in_front_of(image, nobody[image.pair])
        box = crop_of(kept)
        if box is not None:
            depth = np.where(kept[box], image.points[box][..., 2], 0.0)
            pixel_mm = float(np.median(depth[depth > 0])) / image.camera.alpha
            solid = without_flying_pixels(depth, STEEPEST * pixel_mm)
            kept[box] = without_speckles(
                solid, STEEPEST * pixel_mm, smallest_patch_mm2 / pixel_mm**2
            )
        return masked(image, kept)

    with ThreadPoolExecutor(workers) as pool:
        return list(pool.map(one, range_images))


def with_subject(cleaned: Sequence[RangeImage]) -> list[RangeImage]:
    """Those that show something of the subject. Raises ScanFailed if none does."""
    seen = [image for image in cleaned if image.valid.any()]
    if not seen:
        raise ScanFailed(
            "nobody stands in the scan volume",
            remedy="look at the lit images; check `volume` in the rig file",
        )
    return seen


def masked(image: RangeImage, kept: Mask) -> RangeImage:
    """The range image with NaN where `kept` (height, width) is false."""
    nan = np.float32(np.nan)
    return replace(
        image,
        points=np.where(kept[..., None], image.points, nan),
        normals=np.where(kept[..., None], image.normals, nan),
        sigma_mm=np.where(kept, image.sigma_mm, nan),
    )


def inside(image: RangeImage, rig_from_camera: RigidTransform, volume: Volume) -> Mask:
    """(height, width): measured, and within the scan volume's upright cylinder."""
    x, y, z = cv2.split(carried(image.points, rig_from_camera))
    with np.errstate(invalid="ignore"):
        within = (x * x + y * y < volume.radius_mm**2) & (z > volume.bottom_mm)
        return within & (z < volume.top_mm) & image.valid


def in_front_of(image: RangeImage, empty: RangeImage) -> Mask:
    """(height, width): measured in front of what the same camera sees without a subject.

    The nearest background of the pixels around counts, for the edges of things in the room.
    """
    window = np.ones((3, 3), np.uint8)
    far = np.where(empty.valid, empty.points[..., 2], np.float32(np.inf))
    with np.errstate(invalid="ignore"):
        return image.points[..., 2] < cv2.erode(far, window) - BACKGROUND_MM


def without_flying_pixels(depth: Floats, step_mm: float, *, supporters: int = 13) -> Floats:
    """Depth (h, w), 0 where there is none, of the pixels that enough neighbours agree with.

    A straight rim of a surface leaves a pixel 14 of its 24 neighbours; a flying pixel hangs between
    the front and the back and finds few within `step_mm` per step. Two passes: the second no
    longer counts what the first cut.
    """
    for _ in range(2):
        there = depth > 0
        count = np.zeros(depth.shape, np.uint8)
        for rows, columns in HALF_WINDOW:
            here, away = _shifted(rows, columns)
            close = np.abs(depth[here] - depth[away]) < step_mm * np.hypot(rows, columns)
            close &= there[here] & there[away]
            count[here] += close
            count[away] += close
        depth = np.where(count >= supporters, depth, np.float32(0.0))
    return depth


def without_speckles(depth: Floats, step_mm: float, smallest_px: float) -> Mask:
    """(h, w): pixels in connected patches of at least `smallest_px`; jumps in depth cut."""
    quanta = np.clip(depth / QUANTUM_MM, 0, 32767).astype(np.int16)
    patches, _ = cv2.filterSpeckles(quanta, 0, int(smallest_px), step_mm / QUANTUM_MM)
    return patches > 0


def _shifted(rows: int, columns: int) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """Slices `here`, `there` such that there is (rows, columns) away from here."""

    def pair(step: int) -> tuple[slice, slice]:
        if step >= 0:
            return slice(0, -step or None), slice(step, None)
        return slice(-step, None), slice(0, step)

    (here_rows, there_rows), (here_columns, there_columns) = pair(rows), pair(columns)
    return (here_rows, here_columns), (there_rows, there_columns)
