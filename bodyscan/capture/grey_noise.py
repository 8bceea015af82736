"""How noisy grey levels are, measured from the stripe sequence itself."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bodyscan.capture.stripe_images import ScanLines

Bytes = NDArray[np.uint8]

LEVELS = 16
ENOUGH_PIXELS = 500
LARGEST_DIFFERENCE = 24
LEAST_VARIANCE = 0.15
"""Rounding to whole grey levels (1/12), and a little."""


def noise_variance(images: ScanLines) -> NDArray[np.float32]:
    """(256,) variance of one frame's grey level, for each grey level.

    Away from the few edges of the coarsest pattern, the brighter of it and its inverse shows what
    the lit frame shows, and the other one what the dark frame shows (without inverses the pattern
    shows one of the two): what differs is noise. It is
    measured for each band of grey levels, because light itself is noisy (and a laser's speckle
    more so), and smoothed by a line a + b grey that is nowhere falling.
    """
    once, again = _seen_twice(images)
    difference = again.astype(np.float32) - once
    plain = (np.abs(difference) <= LARGEST_DIFFERENCE) & (once < 250)
    band, difference = once[plain] // LEVELS, difference[plain]
    count = np.bincount(band, minlength=LEVELS)
    mean = np.bincount(band, difference, LEVELS) / np.maximum(count, 1)
    square = np.bincount(band, difference**2, LEVELS) / np.maximum(count, 1)
    variance = (square - mean**2) / 2.0
    known = count >= ENOUGH_PIXELS
    grey = LEVELS * (np.arange(LEVELS) + 0.5)
    if not known.any():
        return np.ones(256, np.float32)
    rise, base = 0.0, float(np.average(variance[known], weights=count[known]))
    if known.sum() >= 3:
        # Each band's variance is known to the same relative precision for the same count.
        weight = np.sqrt(count[known]) / np.maximum(variance[known], LEAST_VARIANCE)
        slope, start = np.polyfit(grey[known], variance[known], 1, w=weight)
        if slope > 0:
            rise, base = float(slope), float(start)
    return np.maximum(base + rise * np.arange(256), LEAST_VARIANCE).astype(np.float32)


def _seen_twice(images: ScanLines) -> tuple[Bytes, Bytes]:
    """Grey levels (N,) of pixels in two frames that differ by noise alone."""
    pattern, half = images.patterns[0], slice(None, None, 2)
    if images.inverses is None:
        once = np.where(images.bright(0), images.lit, images.dark)
        return once.ravel()[half], pattern.ravel()[half]
    inverse = images.inverses[0]
    once = np.concatenate([images.lit.ravel()[half], images.dark.ravel()[half]])
    again = [np.maximum(pattern, inverse).ravel()[half], np.minimum(pattern, inverse).ravel()[half]]
    return once, np.concatenate(again)
