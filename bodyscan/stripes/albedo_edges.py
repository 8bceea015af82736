"""Correction of stripe boundaries that fall on an edge of the surface's own brightness.

A pixel gathers light around its centre x with a Gaussian weight of variance blur^2 (lens and pixel).
On an edge between black and white the white side contributes more: the light's centroid is
x + blur^2 grad(ln a), with a the image of the surface, and the s that a pixel shows is that of its
centroid. Boundaries are moved by that much, up to 0.6 px on a printed board.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from bodyscan.arrays import Array, Floats, Indices, Mask, find_crop
from bodyscan.compiled import compiled
from bodyscan.stripes.scan_lines import ScanLines

UNEXPLAINED = 0.3
"""Standard deviation of the correction, relative to it: blur is not exactly Gaussian."""


@dataclass(frozen=True, eq=False)
class Brightness:
    """Logarithm of the surface's brightness at the pixels of scan lines, (L, P) each.

    logarithm, noise2: of lit minus dark, and its variance.
    across: gradient from line to line, 1/px, shrunk to that of the shading where noise may explain
        the difference.
    shading: gradient along the line, smoothed over 7 x 7 pixels.
    """

    logarithm: Floats
    noise2: Floats
    across: Floats
    shading: Floats

    @staticmethod
    def from_images(images: ScanLines, variance: Floats, usable: Mask) -> Brightness:
        """Measure it. variance: (256,) of each grey level; usable: (L, P) lit pixels."""
        # With whole grey levels there is at least one wherever there is any light.
        floor = np.float32(1.0 if images.lit.dtype == np.uint8 else 0.02)
        contrast: Floats = np.maximum(images.contrast, floor)
        at_lit, at_dark = (variance[g.astype(np.uint8)] for g in (images.lit, images.dark))
        logarithm: Floats = np.log(contrast)
        noise2: Floats = (at_lit + at_dark) / (contrast * contrast)
        along, across = fit_gradient(logarithm, usable)
        _sharpen(logarithm, noise2, across)
        return Brightness(logarithm, noise2, across, along)

    def at_boundaries(self, pixels: Indices) -> BoundaryBrightness:
        """Estimate the brightness between flat pixels (N,) and the next ones on their lines."""
        fields = self.logarithm, self.noise2, self.across, self.shading
        left, noise2, across, smooth = (x.ravel()[pixels].astype(np.float64) for x in fields)
        right = self.logarithm.ravel()[pixels + 1]
        along = smooth + _shrink(right - left - smooth, 2.0 * noise2)
        middle, half = np.exp((left + right) / 2), np.exp(along / 2)
        sigma = np.sqrt(2.0 * noise2)
        return BoundaryBrightness(middle / half, middle * half, along, across, sigma)


@dataclass(frozen=True, eq=False)
class BoundaryBrightness:
    """The surface's brightness where N boundaries pass between two pixels of a line, (N,) each.

    before, after: lit minus dark of the two pixels, brought together as far as noise explains.
    along, across: grad(ln a), 1/px, along the line and from line to line; sigma: of `along`.
    """

    before: Array
    after: Array
    along: Array
    across: Array
    sigma: Array

    def estimate_blur2(self, position: Array, joined: Mask) -> float:
        """Estimate blur^2, px^2, such that boundaries at edges line up with their neighbours.

        position: (N,) px along the line; joined: (N - 1,) whether the next boundary is of the same
            run. With fewer than 100 edges, that of a lens of 0.6 px and a pixel.
        """
        steepness, shift = (x[1:-1] - (x[:-2] + x[2:]) / 2 for x in (self.along, position))
        edge = np.abs(steepness) > np.maximum(0.5, 5.0 * self.sigma[1:-1])
        edge &= joined[:-1] & joined[1:]
        shifts = shift[edge] / steepness[edge]
        return 0.45 if shifts.size < 100 else float(np.clip(-np.median(shifts), 0.0, 2.0))

    def shift_sigma(self, blur2: float) -> Array:
        """Compute the standard deviation (N,) px of the shift blur2 * (along, across)."""
        noise = np.minimum(self.sigma, np.abs(self.along))
        return blur2 * np.hypot(UNEXPLAINED * np.hypot(self.along, self.across), noise)


def correct_across_lines(
    s: Floats, sigma: Floats, brightness: Brightness, blur2: float
) -> tuple[Floats, Floats]:
    """Correct s (L, P) for edges of brightness along the scan lines; return s and its sigma.

    A pixel shows s at its light's centroid, which lies off the line by blur2 * across.
    """
    corrected, total = np.empty(s.shape, np.float32), np.empty(s.shape, np.float32)
    s, sigma, across = map(np.ascontiguousarray, (s, sigma, brightness.across))
    _correct(s, sigma, across, blur2, corrected, total)
    return corrected, total


def fit_gradient(image: Floats, usable: Mask) -> tuple[Floats, Floats]:
    """Fit a plane to the usable pixels in 7 x 7 windows: its gradient along and across the lines
    (L, P), 1/px; 0 at unusable pixels and with fewer than 12 usable ones."""
    along, across = np.zeros((2, *image.shape), np.float32)
    box = find_crop(usable)
    if box is None:
        return along, across
    inside = usable[box].astype(np.float32)
    values = image[box] * inside
    powers = [np.arange(-3.0, 4.0, dtype=np.float32) ** k for k in range(3)]

    def mean(of: Floats, x: int, y: int) -> Floats:
        border = cv2.BORDER_CONSTANT
        sums = cv2.sepFilter2D(of, -1, powers[x], powers[y], borderType=border)
        return cv2.divide(sums, count)

    count = cv2.boxFilter(inside, -1, (7, 7), normalize=False, borderType=cv2.BORDER_CONSTANT)
    x, y, value = mean(inside, 1, 0), mean(inside, 0, 1), mean(values, 0, 0)
    xx, yy = mean(inside, 2, 0) - x * x, mean(inside, 0, 2) - y * y
    xy = mean(inside, 1, 1) - x * y
    xv, yv = mean(values, 1, 0) - x * value, mean(values, 0, 1) - y * value
    area = xx * yy - xy * xy
    # An area of 0.5 px^4 is half of that of two lines.
    known = usable[box] & (count >= 11.5) & (area > 0.5)
    np.divide(yy * xv - xy * yv, area, out=along[box], where=known)
    np.divide(xx * yv - xy * xv, area, out=across[box], where=known)
    return along, across


def _shrink(gradient: NDArray[Any], variance: NDArray[Any]) -> NDArray[Any]:
    """Gradients, shrunk towards zero if they are no more than some 2.5 sigmas."""
    square = gradient * gradient
    return np.asarray(gradient * square / (square + 2.5**2 * variance + 1e-12))


def _sharpen(logarithm: Floats, noise2: Floats, across: Floats) -> None:
    """Add to the smooth gradient from line to line (L, P) what noise does not explain."""
    slope = (logarithm[2:] - logarithm[:-2]) / np.float32(2)
    variance = (noise2[2:] + noise2[:-2]) / np.float32(4)
    across[1:-1] += _shrink(slope - across[1:-1], variance)


@compiled
def _correct(
    s: Floats, sigma: Floats, across: Floats, blur2: float, corrected: Floats, total: Floats
) -> None:
    """Write s and its standard deviation (L, P), see `correct_across_lines`."""
    lines = s.shape[0]
    for line in range(lines):
        for x in range(s.shape[1]):
            here = s[line, x]
            corrected[line, x] = total[line, x] = np.nan
            if math.isnan(here):
                continue
            above = s[line - 1, x] if line > 0 else np.float32(np.nan)
            below = s[line + 1, x] if line + 1 < lines else np.float32(np.nan)
            slope = (below - above) / np.float32(2)
            # At the end of the surface only the change on the inner side is known.
            if math.isnan(slope):
                slope = here - above if math.isnan(below) else below - here
            bias = 0.0
            if abs(slope) < 1.0:  # a steeper one crosses to another surface
                bias = slope * min(max(blur2 * across[line, x], -0.6), 0.6)
            corrected[line, x] = here - bias
            total[line, x] = math.sqrt(sigma[line, x] ** 2 + (2.0 * UNEXPLAINED * bias) ** 2)
