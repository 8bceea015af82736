"""Noise of grey levels, measured from the stripe sequence itself."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.optimize import isotonic_regression

from bodyscan.arrays import Array, Floats, Greys, Indices, Mask
from bodyscan.compiled import compiled
from bodyscan.stripes.scan_lines import ScanLines

BANDS = 16
EDGES = 16.0 * np.arange(BANDS + 1)
"""Of the bands, grey levels."""
FINE_EDGES = np.array([*(0, 1, 2, 3, 4, 6, 8, 12, 16), *(24, 32, 48, 64, 96, 128, 192, 256)], float)
"""The same where levels are finer: across half an octave noise changes by less than a factor of two,
even if light itself makes it."""
ENOUGH_PIXELS = 500
LARGEST_DIFFERENCE = 24.0
OUTLYING, ROUNDS = 4.0, 8
"""Sigmas beyond which a difference is no noise where levels are finer: 24 levels are then hundreds of
sigmas. Each round narrows that at least by half while edges, up to a tenth of a band, rule it."""
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
    because light itself is noisy (laser speckle more so), and smoothed by `fitted_variance`.
    """
    nothing = np.empty((0, 0), images.lit.dtype)
    inverse = nothing if images.inverses is None else images.inverses[0]
    bright = images.bright(0) if images.inverses is None else nothing.astype(bool)
    frames = (images.lit, images.dark, images.patterns[0], inverse, bright)
    whole = images.lit.dtype == np.uint8
    edges, rounds = (EDGES, 1) if whole else (FINE_EDGES, ROUNDS)
    band = np.searchsorted(edges, np.arange(256), side="right") - 1
    most = np.full(BANDS, LARGEST_DIFFERENCE)
    for _ in range(rounds):
        count, total, square, level = _sums(*frames, band, 0.0 if whole else 0.5, most)
        mean = total / np.maximum(count, 1)
        variance = (square / np.maximum(count, 1) - mean**2) / 2.0
        most = np.minimum(most, OUTLYING * np.sqrt(2.0 * variance))
    known = count >= ENOUGH_PIXELS
    grey = (edges[1:] + edges[:-1]) / 2.0 if whole else level / np.maximum(count, 1)
    return fitted_variance(grey[known], variance[known], count[known], images.lit.dtype)


def fitted_variance(grey: Array, variance: Array, count: Array, of: np.dtype[Any]) -> Floats:
    """Variance (256,) of each grey level, from bands of them: a line that nowhere decreases and
    stays above the rounding of images of type `of`.

    grey, variance, count: (N,) mean grey level, variance and number of pixels of N bands, the
        darkest first.

    Where levels are finer the line may have bends: merged exposures are tens of times less noisy in
    the dark than where the longer one is white, and a straight line to there is below zero here.
    """
    least = LEAST_VARIANCE if of == np.uint8 else LEAST_FINE_VARIANCE
    if not len(grey):
        return np.ones(256, np.float32)
    if of != np.uint8:
        bent = isotonic_regression(variance, weights=count).x
        return np.maximum(np.interp(np.arange(256), grey, bent), least).astype(np.float32)
    rise, base = 0.0, float(np.average(variance, weights=count))
    if len(grey) >= 3:
        # Bands with equal counts know their variances to the same relative precision.
        weight = np.sqrt(count) / np.maximum(variance, least)
        slope, start = np.polyfit(grey, variance, 1, w=weight)
        if slope > 0:
            rise, base = float(slope), float(start)
    return np.maximum(base + rise * np.arange(256), least).astype(np.float32)


@compiled
def _sums(
    lit: Greys,
    dark: Greys,
    pattern: Greys,
    inverse: Greys,
    bright: Mask,
    band: Indices,
    share: float,
    most: Array,
) -> Array:
    """Number, sum and sum of squares of differences between two frames that show the same, and sum
    of levels (BANDS,), see `_add`.

    Of every other pixel on every other line. Without an inverse (0, 0), `bright` (L, P) says where
    the pattern shows the same as the lit frame.
    """
    sums = np.zeros((4, most.size))
    for line in range(0, lit.shape[0], 2):
        for place in range(0, lit.shape[1], 2):
            seen, light, black = pattern[line, place], lit[line, place], dark[line, place]
            if inverse.size:
                other = inverse[line, place]
                _add(sums, light, max(seen, other), band, share, most)
                _add(sums, black, min(seen, other), band, share, most)
            else:
                _add(sums, light if bright[line, place] else black, seen, band, share, most)
    return sums


@compiled
def _add(sums: Array, once: float, again: float, band: Indices, share: float, most: Array) -> None:
    """band: (256,) of each grey level.
    share: of the second frame in the level; half of each is independent of their difference, which
        matters in bands as narrow as the noise.
    most: (BANDS,) beyond which a difference is no noise.
    """
    difference = np.float64(again) - np.float64(once)
    level = np.float64(once) + share * difference
    own = band[np.int64(level)]
    if abs(difference) <= most[own] and once < BRIGHTEST:
        sums[0, own] += 1
        sums[1, own] += difference
        sums[2, own] += difference * difference
        sums[3, own] += level
