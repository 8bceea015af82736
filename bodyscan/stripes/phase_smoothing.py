"""Less noise for pixels that each give s by themselves: a quadratic fitted around each of them.

The fit over 3 x 3 pixels preserves whatever changes only along lines or only along columns, however
sharply; it removes only what changes from pixel to pixel both ways, which a lens and a pixel blur
away on any surface. The noise that is left is correlated between neighbours.
Source: Savitzky and Golay, Analytical Chemistry 36 (1964), in two dimensions.
"""

from __future__ import annotations

import cv2
import numpy as np

from bodyscan.arrays import Floats

WEIGHTS = np.array([[-1, 2, -1], [2, 5, 2], [-1, 2, -1]], np.float32) / np.float32(9.0)
"""Weights of the pixels for the fitted quadratic's value in the middle."""

LEFT = np.float32(np.sqrt(np.sum(np.square(WEIGHTS))))
ALIKE_PX = 1.2
"""Within which neighbours share noise afterwards, as `StripeMap.alike_px`: the fit keeps all that
varies slowly, so a mean of many pixels is as noisy as before, not `LEFT` times that."""
MAX_STRAY = 4.0
"""Sigmas; where the fit would change s by more there is an edge, not noise: s is kept."""


def smooth_phase(s: Floats, sigma: Floats) -> tuple[Floats, Floats]:
    """s and its standard deviation (L, P), NaN where there is
    none, smoothed where all nine have s."""
    fitted = cv2.filter2D(s, cv2.CV_32F, WEIGHTS, borderType=cv2.BORDER_CONSTANT)
    fitted[[0, -1]] = np.nan
    fitted[:, [0, -1]] = np.nan
    kept = np.abs(fitted - s) <= MAX_STRAY * sigma
    return np.where(kept, fitted, s), np.where(kept, LEFT * sigma, sigma)
