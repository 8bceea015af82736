"""Noise of grey levels, measured from a sequence of patterns itself."""

from __future__ import annotations

from typing import Any

import numpy as np

from bodyscan.arrays import Array, Floats, Greys, Indices, Mask
from bodyscan.compiled import compiled
from bodyscan.stripes.scan_lines import ScanLines

BANDS = 16
"""Bands of grey levels in which noise is measured."""
MIN_PIXELS = 500
"""Pixels that determine a band's variance to some 6 %."""


def measure_noise(images: ScanLines) -> Floats:
    """Measure the variance (256,) of one image's grey level, for each grey level.

    Away from the coarsest pattern's edges, the brighter of it and its inverse equals the lit frame,
    the other the dark frame; differences are noise, measured in bands of grey levels.
    """
    empty = np.empty((0, 0), images.lit.dtype)
    inverse = empty if images.inverses is None else images.inverses[0]
    bright = images.bright(0) if images.inverses is None else empty.astype(bool)
    frames = (images.lit, images.dark, images.patterns[0], inverse, bright)
    if images.lit.dtype == np.uint8:
        edges, rounds, share = 16.0 * np.arange(BANDS + 1), 1, 0.0
    else:
        # Across half an octave noise changes by less than a factor of two, even if light makes it.
        # Half of the second frame's level is independent of the difference, which matters in bands
        # as narrow as the noise. 24 levels are hundreds of sigmas: each round narrows the limit at
        # least by half while edges, up to a tenth of a band, rule it.
        low = (0, 1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128, 192, 256)
        edges, rounds, share = np.array(low, float), 8, 0.5
    band = np.searchsorted(edges, np.arange(256), side="right") - 1
    max_difference = np.full(BANDS, 24.0)
    for _ in range(rounds):
        count, total, square, level = _sum_differences(*frames, band, share, max_difference)
        mean = total / np.maximum(count, 1)
        variance = (square / np.maximum(count, 1) - mean**2) / 2.0
        max_difference = np.minimum(max_difference, 4.0 * np.sqrt(2.0 * variance))
    known = count >= MIN_PIXELS
    grey = level / np.maximum(count, 1) if rounds > 1 else (edges[1:] + edges[:-1]) / 2.0
    return fit_variance(grey[known], variance[known], count[known], images.lit.dtype)


def fit_variance(grey: Array, variance: Array, count: Array, dtype: np.dtype[Any]) -> Floats:
    """Fit the variance (256,) of each grey level to that of bands: nowhere decreasing, and above
    the rounding of images of type `dtype`.

    grey, variance, count: (N,) mean grey level, variance and pixels of N bands, the darkest first.

    The fit is linear for whole grey levels and isotonic for finer ones: merged exposures are tens
    of times less noisy in the dark, where a line would be negative.
    """
    # Rounding to whole levels (1/12) with a margin; for 12 bits, 16 times finer.
    min_variance = 0.15 if dtype == np.uint8 else 0.15 / 16.0**2
    if not len(grey):
        return np.ones(256, np.float32)
    if dtype != np.uint8:
        from scipy.optimize import isotonic_regression  # imported here: 8 bits do not need it

        fitted = isotonic_regression(variance, weights=count).x
        return np.maximum(np.interp(np.arange(256), grey, fitted), min_variance).astype(np.float32)
    rise, base = 0.0, float(np.average(variance, weights=count))
    if len(grey) >= 3:
        # Bands with equal counts determine their variances to the same relative precision.
        weight = np.sqrt(count) / np.maximum(variance, min_variance)
        slope, start = np.polyfit(grey, variance, 1, w=weight)
        if slope > 0:
            rise, base = float(slope), float(start)
    return np.maximum(base + rise * np.arange(256), min_variance).astype(np.float32)


@compiled
def _sum_differences(
    lit: Greys,
    dark: Greys,
    pattern: Greys,
    inverse: Greys,
    bright: Mask,
    band: Indices,
    share: float,
    max_difference: Array,
) -> Array:
    """Sum 1, d, d^2 and grey level (4, BANDS) over pairs of frames that differ by noise d alone. Of
    every other pixel on every other line. `bright` (L, P) stands in for a missing inverse."""
    sums = np.zeros((4, max_difference.size))
    for line in range(0, lit.shape[0], 2):
        for x in range(0, lit.shape[1], 2):
            level, light, black = pattern[line, x], lit[line, x], dark[line, x]
            if inverse.size:
                other = inverse[line, x]
                _accumulate(sums, light, max(level, other), band, share, max_difference)
                _accumulate(sums, black, min(level, other), band, share, max_difference)
            else:
                expected = light if bright[line, x] else black
                _accumulate(sums, expected, level, band, share, max_difference)
    return sums


@compiled
def _accumulate(
    sums: Array, first: float, second: float, band: Indices, share: float, max_difference: Array
) -> None:
    """Add a difference of two frames to its band's sums; share: weight of `second` in its level."""
    difference = np.float64(second) - np.float64(first)
    level = np.float64(first) + share * difference
    k = band[np.int64(level)]
    if abs(difference) <= max_difference[k] and first < 250:  # saturated pixels show no noise
        sums[0, k] += 1
        sums[1, k] += difference
        sums[2, k] += difference * difference
        sums[3, k] += level
