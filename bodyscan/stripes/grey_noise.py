"""Noise of grey levels, measured from the stripe sequence itself."""

from __future__ import annotations

from typing import Any

import numpy as np

from bodyscan.arrays import Array, Floats, Greys, Mask
from bodyscan.compiled import compiled
from bodyscan.stripes.scan_lines import ScanLines

LEVELS = 16
ENOUGH_PIXELS = 500
LARGEST_DIFFERENCE = 24
BRIGHTEST = 250
LEAST_VARIANCE = 0.15
"""Rounding to whole grey levels (1/12), with a margin."""

LEAST_FINE_VARIANCE = LEAST_VARIANCE / 16.0**2
"""The same for 12 bits: anything more is noise in any camera."""


def noise_variance(images: ScanLines) -> Floats:
    """Variance (256,) of one frame's grey level, for each grey level.

    Away from the few edges of the coarsest pattern, the brighter of it and its inverse shows the
    same as the lit frame, and the other the same as the dark frame (without inverses the pattern
    shows one of the two): the difference is noise. It is measured for each band of grey levels,
    because light itself is noisy (laser speckle more so), and smoothed by a non-decreasing line a +
    b grey.
    """
    nothing = np.empty((0, 0), images.lit.dtype)
    inverse = nothing if images.inverses is None else images.inverses[0]
    bright = images.bright(0) if images.inverses is None else nothing.astype(bool)
    count, total, square = _sums(images.lit, images.dark, images.patterns[0], inverse, bright)
    mean = total / np.maximum(count, 1)
    variance = (square / np.maximum(count, 1) - mean**2) / 2.0
    known = count >= ENOUGH_PIXELS
    grey = LEVELS * (np.arange(LEVELS) + 0.5)
    return fitted_variance(grey[known], variance[known], count[known], images.lit.dtype)


def fitted_variance(grey: Array, variance: Array, count: Array, of: np.dtype[Any]) -> Floats:
    """Variance (256,) of each grey level, from bands of them: a line that nowhere decreases and
    stays above the rounding of images of type `of`.

    grey, variance, count: (N,) mean grey level, variance and number of pixels of N bands.
    """
    least = LEAST_VARIANCE if of == np.uint8 else LEAST_FINE_VARIANCE
    if not len(grey):
        return np.ones(256, np.float32)
    rise, base = 0.0, float(np.average(variance, weights=count))
    if len(grey) >= 3:
        # Bands with equal counts know their variances to the same relative precision.
        weight = np.sqrt(count) / np.maximum(variance, least)
        slope, start = np.polyfit(grey, variance, 1, w=weight)
        if slope > 0:
            rise, base = float(slope), float(start)
    return np.maximum(base + rise * np.arange(256), least).astype(np.float32)


@compiled
def _sums(lit: Greys, dark: Greys, pattern: Greys, inverse: Greys, bright: Mask) -> Array:
    """Number, sum and sum of squares (LEVELS,) of differences between two frames that show the
    same.

    By bands of grey levels; of every other pixel on every other line. Without an inverse (0, 0),
    `bright` (L, P) says where the pattern shows the same as the lit frame.
    """
    sums = np.zeros((3, LEVELS))
    for line in range(0, lit.shape[0], 2):
        for place in range(0, lit.shape[1], 2):
            seen, light, black = pattern[line, place], lit[line, place], dark[line, place]
            if inverse.size:
                other = inverse[line, place]
                _add(sums, light, max(seen, other))
                _add(sums, black, min(seen, other))
            else:
                _add(sums, light if bright[line, place] else black, seen)
    return sums


@compiled
def _add(sums: Array, once: float, again: float) -> None:
    difference = np.float64(again) - np.float64(once)
    if abs(difference) <= LARGEST_DIFFERENCE and once < BRIGHTEST:
        band = np.int64(once) // LEVELS
        sums[0, band] += 1
        sums[1, band] += difference
        sums[2, band] += difference * difference
