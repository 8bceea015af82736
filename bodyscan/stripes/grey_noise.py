"""How noisy grey levels are, measured from the stripe sequence itself."""

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
"""Rounding to whole grey levels (1/12), and a little."""

LEAST_FINE_VARIANCE = LEAST_VARIANCE / 16.0**2
"""The same of 12 bits: what has more is noise in any camera."""


def noise_variance(images: ScanLines) -> Floats:
    """(256,) variance of one frame's grey level, for each grey level.

    Away from the few edges of the coarsest pattern, the brighter of it and its inverse shows what
    the lit frame shows, and the other one what the dark frame shows (without inverses the pattern
    shows one of the two): what differs is noise. It is
    measured for each band of grey levels, because light itself is noisy (and a laser's speckle
    more so), and smoothed by a line a + b grey that is nowhere falling.
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
    """(256,) from the variance (N,) seen in N bands about grey levels `grey`, of `count` pixels each:
    a line that is nowhere falling, and nowhere below the rounding of images of type `of`."""
    least = LEAST_VARIANCE if of == np.uint8 else LEAST_FINE_VARIANCE
    if not len(grey):
        return np.ones(256, np.float32)
    rise, base = 0.0, float(np.average(variance, weights=count))
    if len(grey) >= 3:
        # Each band's variance is known to the same relative precision for the same count.
        weight = np.sqrt(count) / np.maximum(variance, least)
        slope, start = np.polyfit(grey, variance, 1, w=weight)
        if slope > 0:
            rise, base = float(slope), float(start)
    return np.maximum(base + rise * np.arange(256), least).astype(np.float32)


@compiled
def _sums(lit: Greys, dark: Greys, pattern: Greys, inverse: Greys, bright: Mask) -> Array:
    """How many, sum and sum of squares (LEVELS,) of what differs between two frames that show the
    same, by bands of grey levels; of every other pixel of every other line.

    Without an inverse (0, 0), `bright` (L, P) says where the pattern shows what the lit frame does.
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
