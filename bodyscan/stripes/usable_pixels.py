"""Selection of the pixels of a stripe sequence that show the projector's light clearly enough."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from bodyscan.arrays import Floats, Mask
from bodyscan.errors import DecodingFailed, WrongDirection
from bodyscan.stripes.scan_lines import WHOLE_SHARE, ScanLines

SATURATED = 254
MIN_CONTRAST = 4.0
MIN_CONTRAST_TO_NOISE = 5.0


def find_min_contrast(dtype: np.dtype[Any]) -> float:
    """Minimum contrast in grey levels for images of type `dtype`: fewer whole levels are rounding
    errors; with finer ones, noise alone decides."""
    return MIN_CONTRAST if dtype == np.uint8 else 0.0


def find_usable_pixels(
    images: ScanLines, codes: NDArray[np.int32], variance: Floats, stripes: int, fine_bit: int
) -> tuple[Mask, Mask]:
    """Find the pixels (L, P) whose stripes `codes` can be relied on, and all that are lit well.

    Excluded from both are low contrast, saturation, codes that were not projected, half-covered
    pixels at rims, and mostly indirect light; from the former also pixels next to a jump of the
    code by more than one.

    variance: (256,) of each grey level. fine_bit: see `find_direct_pixels`.
    """
    contrast = cv2.subtract(images.lit, images.dark)
    needed = np.maximum(
        find_min_contrast(contrast.dtype), MIN_CONTRAST_TO_NOISE * np.sqrt(variance)
    )
    if contrast.dtype == np.uint8:
        needed = np.minimum(np.ceil(needed), 255).astype(np.uint8)
        bright = contrast >= cv2.LUT(cv2.max(images.lit, images.dark), needed)
    else:
        bright = contrast >= needed[np.maximum(images.lit, images.dark).astype(np.uint8)]
    bright &= ~find_half_covered_pixels(contrast, bright)
    coded = bright & (images.lit < SATURATED) & (codes >= 0) & (codes < stripes)
    usable = coded & ~find_code_jumps(codes, coded)
    direct = find_direct_pixels(images, usable, fine_bit, variance)
    return usable & direct, coded & direct


def find_half_covered_pixels(contrast: NDArray[Any], lit: Mask) -> Mask:
    """Find pixels (L, P) next to one that is not lit and much darker than their brightest neighbour.

    They straddle the rim of the surface, and show s of its part of them, not of their centre.
    """
    window = np.ones((3, 3), np.uint8)
    at_rim = cv2.erode(lit.view(np.uint8), window, borderValue=1) == 0
    return at_rim & (contrast < np.float32(0.7) * cv2.dilate(contrast, window))


def find_direct_pixels(images: ScanLines, usable: Mask, bit: int, variance: Floats) -> Mask:
    """Find the pixels (L, P) that get more light from the projector than from other surfaces.

    usable: (L, P) pixels to examine. bit: the pattern with stripes two wide.
    variance: (256,) of each grey level.

    A fine pattern minus its inverse is about +- the direct light (Nayar et al. 2006); a bit is
    certain where that exceeds the rest (Xu and Aliaga 2007). The finest bit decides, or the next
    coarser one that the projector shows sharply, to 0.8 of the contrast in a tenth of the pixels.
    Dips where the bit flips, up to 7 px wide, are filled.
    """
    window = np.ones((1, 7), np.uint8)
    for fine in range(bit, max(bit - 3, -1), -1):
        share = images.direct_share(fine, variance)
        filled = cv2.morphologyEx(share, cv2.MORPH_CLOSE, window)
        sharp = np.count_nonzero((filled >= 0.8 * WHOLE_SHARE) & usable)
        if sharp and sharp >= 0.1 * np.count_nonzero(usable):
            return np.asarray(filled >= 0.5 * WHOLE_SHARE)
    return np.ones_like(usable)


def find_code_jumps(codes: NDArray[np.int32], usable: Mask) -> Mask:
    """Find pixels (L, P) whose code differs from a usable neighbour's by more than one."""
    jumps = np.zeros(codes.shape, bool)
    for one, other in ((np.s_[1:], np.s_[:-1]), (np.s_[:, 1:], np.s_[:, :-1])):
        jump = (cv2.absdiff(codes[one], codes[other]) > 1) & usable[one] & usable[other]
        jumps[one] |= jump
        jumps[other] |= jump
    return jumps


def check_illumination(bright: Mask, lit: NDArray[Any]) -> None:
    """Raise DecodingFailed if the projector lights next to nothing, or most of it too brightly.

    bright: pixels that the projector lights.
    lit: their grey levels then.
    """
    share = np.mean(bright)
    if share < 1e-3:
        raise DecodingFailed(
            f"the projector lights only {share:.2%} of the image",
            remedy="check that the projector is on, that lit and dark frames differ, and that no frame "
            "is missing: a missing frame shifts all later ones",
        )
    saturated = np.mean(lit[bright] >= SATURATED)
    if saturated > 0.5:
        raise DecodingFailed(
            f"{saturated:.0%} of the lit pixels are saturated", remedy="expose for a shorter time"
        )


def check_direction(numbers: NDArray[Any], good: Mask, transposed: bool) -> None:
    """Raise WrongDirection if stripes change from line to line rather than along lines.

    numbers: (L, P) code words or stripes, compared at `good` pixels.
    transposed: see `ScanLines`.
    """
    across = np.count_nonzero((np.diff(numbers, axis=0) != 0) & good[1:] & good[:-1])
    along = np.count_nonzero((np.diff(numbers, axis=1) != 0) & good[:, 1:] & good[:, :-1])
    if across > 2.0 * along:
        actual, given = ("vertical", "horizontal") if transposed else ("horizontal", "vertical")
        raise WrongDirection(
            f"the stripes run {actual}ly in the image, not {given}ly",
            remedy=f"write `direction: {actual}` in the rig file if this camera stands so; with "
            "`crossing`, check first whether its frames and the others are exchanged",
        )
