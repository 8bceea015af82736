"""Light that reaches a pixel by way of another surface: in armpits, between legs, in shadows.

A pixel's lit minus dark is D + I: direct light, and light from other surfaces. A pattern minus its
inverse is +-D + J; J is the part of the indirect light that differs between pattern and inverse:
little if stripes are fine, anything up to I if they are broad (Nayar et al. 2006). So a bit is
certain where D > I (Xu and Aliaga 2007), which the finest patterns show; and a boundary lies where
the difference is J, not 0: midway between the values on its two sides.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from bodyscan.arrays import Array, Floats, Greys, Indices, Mask
from bodyscan.compiled import compiled
from bodyscan.stripes.scan_lines import WHOLE_SHARE, ScanLines

LEAST_DIRECT = 0.5
WIDEST_DIP_PX = 7
FINE_BITS = 3
BEST, SHARP = 90, 0.8
"""A pattern is sharp if this percentile of the pixels' shares is at least this much."""

BESIDE_PX = (3, 4, 5, 6)
"""Distances from the two pixels around a boundary to those that are clear of it."""
FEWEST_STRIPES = 2
"""Least reach that is of use."""
AT_A_TIME = 1 << 14  # boundaries: their pixels' values fit into a processor's cache
LEAST_CONTRAST = 0.02
"""Grey levels: below that of any usable pixel."""

SIGNIFICANCE = 4.0
UNEXPLAINED = 0.3


def mostly_direct(images: ScanLines, usable: Mask, bit: int, variance: Floats) -> Mask:
    """Pixels (L, P) that get more light from the projector than from other surfaces.

    usable: (L, P) pixels to examine.
    bit: the pattern with stripes two wide.
    variance: (256,) of each grey level.

    That bit decides, or the next coarser one that the projector shows sharply (in procam-board its
    lens leaves a fifth of the finest). Where a bit flips its difference is small whatever the
    light; such dips along the lines are filled.
    """
    dips = np.ones((1, WIDEST_DIP_PX), np.uint8)
    for fine in range(bit, max(bit - FINE_BITS, -1), -1):
        share = images.direct_share(fine, variance)
        filled = cv2.morphologyEx(share, cv2.MORPH_CLOSE, dips)
        sharp = np.count_nonzero((filled >= SHARP * WHOLE_SHARE) & usable)
        if sharp and sharp >= (1.0 - BEST / 100.0) * np.count_nonzero(usable):
            return np.asarray(filled >= LEAST_DIRECT * WHOLE_SHARE)
    return np.ones_like(usable)


def imbalance(
    images: ScanLines,
    codes: NDArray[np.int32],
    usable: Mask,
    variance: Floats,
    bit: Indices,
    index: Indices,
    at: Indices,
    reach: Indices,
) -> tuple[Array, Array]:
    """J / (D + I) at boundaries `index` (N,) of `bit` (N,), and its uncertainty.

    at: (N,) flat pixels before the boundaries.
    reach: (N,) number of stripes on either side in which the bit surely keeps its value.

    It is 0 where noise may explain it, and for the finest bit, which has no room beside its
    boundaries and whose J is least.
    """
    mean, doubt = np.zeros(len(at)), np.zeros(len(at))
    roomy = np.flatnonzero(reach >= FEWEST_STRIPES)
    for some in np.array_split(roomy, 1 + len(roomy) // AT_A_TIME):
        pixels = _beside(codes, usable, at[some], index[some], reach[some])
        difference, noise = images.difference(bit[some], pixels, variance)
        mean[some], doubt[some] = _mean_imbalance(
            images.lit.ravel(), images.dark.ravel(), pixels, difference, noise
        )
    return mean, doubt


@compiled
def _beside(
    codes: NDArray[np.int32], usable: Mask, at: Indices, index: Indices, reach: Indices
) -> Indices:
    """Flat pixels (N, 2 * len(BESIDE_PX)) on both sides of boundaries, clear of this one and of
    where the bit flips again; -1 in place of both if one is not."""
    width = codes.shape[1]
    found = np.full((at.size, 2 * len(BESIDE_PX)), -1)
    for k in range(at.size):
        line, place = divmod(at[k], width)
        for n, step in enumerate(BESIDE_PX):
            one, other = place - step, place + 1 + step
            if one < 0 or other >= width or not (usable[line, one] and usable[line, other]):
                continue
            off, off_there = codes[line, one] + 0.5 - index[k], codes[line, other] + 0.5 - index[k]
            if off * off_there < 0.0 and max(abs(off), abs(off_there)) < reach[k]:
                found[k, 2 * n], found[k, 2 * n + 1] = line * width + one, line * width + other
    return found


@compiled
def _mean_imbalance(
    lit: Greys, dark: Greys, pixels: Indices, difference: Floats, noise: Floats
) -> tuple[Array, Array]:
    """Mean and uncertainty (N,) for `imbalance`, from differences (N, K) beside each boundary."""
    result, doubt = np.zeros(len(pixels)), np.zeros(len(pixels))
    for k in range(len(pixels)):
        total, size, noise2, count = 0.0, 0.0, 0.0, 0
        for n in range(pixels.shape[1]):
            pixel = pixels[k, n]
            if pixel < 0:
                continue
            bright = max(np.float64(lit[pixel]) - np.float64(dark[pixel]), LEAST_CONTRAST)
            total += difference[k, n] / bright
            size += abs(difference[k, n]) / bright
            noise2 += (noise[k, n] / bright) ** 2
            count += 1
        if count:
            indirect = max(1.0 - size / count, 0.0)
            mean = min(max(total / count, -indirect), indirect)  # |J| <= I
            variance = noise2 / count**2
            kept = mean * mean**2 / (mean**2 + SIGNIFICANCE**2 * variance + 1e-12)
            unsure = min(math.sqrt(variance), abs(kept))
            result[k] = kept
            doubt[k] = math.sqrt(unsure**2 + (UNEXPLAINED * kept) ** 2)
    return result, doubt
