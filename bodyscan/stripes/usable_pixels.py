"""Which pixels of a stripe sequence show the projector's light clearly enough to be decoded."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from bodyscan.arrays import Floats, Mask
from bodyscan.compiled import compiled
from bodyscan.stripes.indirect_light import mostly_direct
from bodyscan.stripes.scan_lines import ScanLines

SATURATED = 254
MIN_CONTRAST = 4.0
MIN_CONTRAST_TO_NOISE = 5.0
WHOLLY_COVERED = 0.7


def least_contrast(of: np.dtype[Any]) -> float:
    """Least contrast in grey levels for images of type `of`: fewer whole grey levels say nothing;
    with finer ones, noise alone decides."""
    return MIN_CONTRAST if of == np.uint8 else 0.0


def usable_pixels(
    images: ScanLines,
    codes: NDArray[np.int32],
    variance: Floats,
    stripes: int,
    fine_bit: int,
) -> Mask:
    """Pixels (L, P) whose stripes `codes` can be relied on: those of `shown_pixels` except for
    pixels beside a jump of the code by more than one (such as a mixed pixel at a depth jump)."""
    return shown_pixels(images, codes, variance, stripes, fine_bit)[0]


def shown_pixels(
    images: ScanLines,
    codes: NDArray[np.int32],
    variance: Floats,
    stripes: int,
    fine_bit: int,
) -> tuple[Mask, Mask]:
    """The usable pixels (L, P), and all that show a code, including those beside its jumps.

    Excluded are low contrast, saturation, codes that were not projected, pixels that the surface's
    rim covers only in part, and pixels that get more light from other surfaces than from the
    projector.

    variance: (256,) of each grey level.
    fine_bit: see `mostly_direct`.
    """
    contrast = cv2.subtract(images.lit, images.dark)
    least = np.maximum(least_contrast(contrast.dtype), MIN_CONTRAST_TO_NOISE * np.sqrt(variance))
    if contrast.dtype == np.uint8:
        least = np.minimum(np.ceil(least), 255).astype(np.uint8)
        bright = contrast >= cv2.LUT(cv2.max(images.lit, images.dark), least)
    else:
        bright = contrast >= least[np.maximum(images.lit, images.dark).astype(np.uint8)]
    bright &= ~half_covered_pixels(contrast, bright)
    shown = bright & (images.lit < SATURATED) & (codes >= 0) & (codes < stripes)
    usable = shown & ~beside_jumps(codes, shown)
    direct = mostly_direct(images, usable, fine_bit, variance)
    return usable & direct, shown & direct


def half_covered_pixels(contrast: NDArray[Any], lit: Mask) -> Mask:
    """Pixels (L, P) beside one that is not lit and much darker than their brightest neighbour.

    They straddle the rim of the surface, and show s of its part of them, not of their centre.
    """
    around = np.ones((3, 3), np.uint8)
    at_rim = cv2.erode(lit.view(np.uint8), around, borderValue=1) == 0
    return at_rim & (contrast < np.float32(WHOLLY_COVERED) * cv2.dilate(contrast, around))


def beside_jumps(codes: NDArray[np.int32], usable: Mask) -> Mask:
    """Pixels (L, P) whose code differs from a usable neighbour's by more than one."""
    jumps = np.zeros(codes.shape, bool)
    _mark_jumps(codes, usable, jumps)
    return jumps


@compiled
def _mark_jumps(codes: NDArray[np.int32], usable: Mask, jumps: Mask) -> None:
    # Without a branch inside: on a noisy image a processor mispredicts every other one.
    lines, places = codes.shape
    for line in range(lines):
        jump = _leaps(codes[line, 1:], codes[line, :-1], usable[line, 1:], usable[line, :-1])
        for place in range(places - 1):
            jumps[line, place] |= jump[place]
        for place in range(places - 1):
            jumps[line, place + 1] |= jump[place]
        if line + 1 == lines:
            break
        jump = _leaps(codes[line + 1], codes[line], usable[line + 1], usable[line])
        for place in range(places):
            jumps[line, place] |= jump[place]
            jumps[line + 1, place] |= jump[place]


@compiled
def _leaps(
    one: NDArray[np.int32], other: NDArray[np.int32], usable: Mask, usable_too: Mask
) -> Mask:
    """Whether two rows' codes, both usable, differ by more than one, (P,)."""
    leap = np.empty(one.size, np.bool_)
    for place in range(one.size):
        leap[place] = (abs(one[place] - other[place]) > 1) & usable[place] & usable_too[place]
    return leap
