"""Correction of stripe boundaries that fall on an edge of the surface's own brightness.

A pixel gathers light around its centre x with a Gaussian weight of variance blur^2 (lens and pixel).
On an edge between black and white the white side contributes more: the light's centroid is
x + blur^2 grad(ln a), with a the image of the surface, and the s that a pixel shows is that of its
centroid. Boundaries are moved by that much, up to 0.6 px on a printed board.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from bodyscan.arrays import Array, Floats, Greys, Indices, Mask, find_crop
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
        """Measure it. variance: (256,) of each grey level; usable: (L, P) pixels on a lit
        surface."""
        if images.lit.dtype == np.uint8:
            logarithms = np.log(np.maximum(np.arange(256), 1)).astype(np.float32)
            logarithm, noise2 = _measure(images.lit, images.dark, variance, logarithms)
        else:
            contrast = np.maximum(images.lit - images.dark, 0.02).astype(np.float32)
            at_lit, at_dark = (variance[g.astype(np.uint8)] for g in (images.lit, images.dark))
            logarithm, noise2 = np.log(contrast), (at_lit + at_dark) / np.square(contrast)
        along, across = fit_gradient(logarithm, usable)
        _sharpen(logarithm, noise2, across)
        return Brightness(logarithm, noise2, across, along)

    def at_boundaries(self, pixels: Indices) -> BoundaryBrightness:
        """Estimate the brightness between flat pixels (N,) and the next ones on their lines."""
        logarithm, noise2 = self.logarithm.ravel(), self.noise2.ravel()
        return BoundaryBrightness(
            *_interpolate(logarithm, noise2, self.across.ravel(), self.shading.ravel(), pixels)
        )


@dataclass(frozen=True, eq=False)
class BoundaryBrightness:
    """The surface's brightness where N stripe boundaries pass between two pixels of a line, (N,)
    each.

    before, behind: lit minus dark of the two pixels, brought together where noise may explain their
        difference.
    along, across: grad(ln a), 1/px, along the line and from line to line; sigma: of `along`.
    """

    before: Array
    behind: Array
    along: Array
    across: Array
    sigma: Array

    def estimate_blur2(self, position: Array, joined: Mask) -> float:
        """Estimate blur^2, px^2, such that boundaries at edges line up with their neighbours.

        position: (N,) px along the line; joined: (N - 1,) whether the next boundary is of the same
            run. With fewer than 100 edges, that of a lens of 0.6 px and a pixel.
        """
        shifts = _measure_shifts(self.along, self.sigma, position, joined)
        return 0.45 if shifts.size < 100 else float(np.clip(-np.median(shifts), 0.0, 2.0))

    def shift_sigma(self, blur2: float) -> Array:
        """Compute the standard deviation (N,) px of the shift blur2 * (along, across)."""
        return _shift_sigma(self.along, self.across, self.sigma, blur2)


def correct_across_lines(
    s: Floats, sigma: Floats, brightness: Brightness, blur2: float
) -> tuple[Floats, Floats]:
    """Correct s (L, P) for edges of brightness that run along the scan lines; return s and its
    sigma.

    A pixel shows s at its light's centroid, which lies off the line by blur2 * across.
    """
    corrected, total = np.empty(s.shape, np.float32), np.empty(s.shape, np.float32)
    s, sigma, across = map(np.ascontiguousarray, (s, sigma, brightness.across))
    _correct(s, sigma, across, blur2, corrected, total)
    return corrected, total


def fit_gradient(image: Floats, usable: Mask) -> tuple[Floats, Floats]:
    """Fit a plane to the usable pixels in 7 x 7 windows: its gradient along and across the lines
    (L, P), 1/px; 0 at unusable pixels and with fewer than 12 usable ones.

    Loops over lines take a quarter of the time of OpenCV's separable filters.
    """
    along, across = np.zeros((2, *image.shape), np.float32)
    box = find_crop(usable)
    if box is not None:
        _fit_gradient(image[box], usable[box], along[box], across[box])
    return along, across


@compiled
def _fit_gradient(image: Floats, usable: Mask, along: Floats, across: Floats) -> None:
    """Write the gradient (L, P) line by line.

    inside, values: usability (1 or 0) and values of the last 7 lines, with zeros on both sides.
    """
    lines, width = image.shape
    inside = np.zeros((7, width + 6), np.float32)
    values = np.zeros_like(inside)
    columns = np.empty((2, 3, width + 6), np.float32)
    for last in range(lines + 3):
        newest, line = last % 7, last - 3
        if last < lines:
            _mask_line(image[last], usable[last], inside[newest, 3:-3], values[newest, 3:-3])
        else:
            inside[newest], values[newest] = 0.0, 0.0
        if line >= 0:
            _sum_columns(inside, line, columns[0])
            _sum_columns(values, line, columns[1])
            _solve_windows(columns, usable[line], along[line], across[line])


@compiled
def _mask_line(image: Floats, usable: Mask, inside: Floats, values: Floats) -> None:
    for x in range(image.size):
        inside[x] = usable[x]
        values[x] = image[x] * inside[x]


@compiled
def _sum_columns(rows: Floats, middle: int, sums: Floats) -> None:
    """Write sums (3, P) of v, y v and y^2 v over columns of 7 lines, y counted from the middle
    line; line k is in row k mod 7."""
    above3, above2, above = rows[(middle - 3) % 7], rows[(middle - 2) % 7], rows[(middle - 1) % 7]
    here, below = rows[middle % 7], rows[(middle + 1) % 7]
    below2, below3 = rows[(middle + 2) % 7], rows[(middle + 3) % 7]
    for u in range(here.size):
        one, two, three = below[u] + above[u], below2[u] + above2[u], below3[u] + above3[u]
        sums[0, u] = here[u] + one + two + three
        sums[2, u] = one + np.float32(4) * two + np.float32(9) * three
        one, two, three = below[u] - above[u], below2[u] - above2[u], below3[u] - above3[u]
        sums[1, u] = one + np.float32(2) * two + np.float32(3) * three


@compiled
def _solve_windows(columns: Floats, usable: Mask, along: Floats, across: Floats) -> None:
    """Write the gradient of a line (P,) from the sums over its columns, (2, 3, P + 6).

    Only with arrays of their own for intermediate results does the compiler know that they do not
    overlap, and computes eight pixels at once. An area of 0.5 px^4 is half of that of two lines.
    """
    ones, ones_y, values = columns[0, 0], columns[0, 1], columns[1, 0]
    n, sum_x, sum_xx = _sum_row(ones), _sum_row_x(ones), _sum_row_x2(ones)
    sum_y, sum_xy, sum_yy = _sum_row(ones_y), _sum_row_x(ones_y), _sum_row(columns[0, 2])
    sum_v, sum_xv, sum_yv = _sum_row(values), _sum_row_x(values), _sum_row(columns[1, 1])
    by_x, by_y, area = np.empty_like(n), np.empty_like(n), np.empty_like(n)
    for u in range(usable.size):
        share = np.float32(1) / n[u]
        x, y, v = sum_x[u] * share, sum_y[u] * share, sum_v[u] * share
        xx, yy = sum_xx[u] * share - x * x, sum_yy[u] * share - y * y
        xy = sum_xy[u] * share - x * y
        xv, yv = sum_xv[u] * share - x * v, sum_yv[u] * share - y * v
        area[u] = xx * yy - xy * xy
        by_x[u], by_y[u] = (yy * xv - xy * yv) / area[u], (xx * yv - xy * xv) / area[u]
    for u in range(usable.size):
        known = usable[u] & (n[u] >= np.float32(11.5)) & (area[u] > np.float32(0.5))
        along[u], across[u] = (by_x[u], by_y[u]) if known else (np.float32(0), np.float32(0))


@compiled
def _sum_row(row: Floats) -> Floats:
    """Sums (P,) of v over 7 pixels of a row (P + 6,)."""
    total = np.empty(row.size - 6, np.float32)
    for u in range(total.size):
        near, far = row[u + 2] + row[u + 4], row[u] + row[u + 6]
        total[u] = row[u + 3] + near + row[u + 1] + row[u + 5] + far
    return total


@compiled
def _sum_row_x(row: Floats) -> Floats:
    """The same sums of x v, with x counted from the window's middle."""
    total = np.empty(row.size - 6, np.float32)
    for u in range(total.size):
        near, far = row[u + 4] - row[u + 2], row[u + 6] - row[u]
        total[u] = near + np.float32(2) * (row[u + 5] - row[u + 1]) + np.float32(3) * far
    return total


@compiled
def _sum_row_x2(row: Floats) -> Floats:
    """The same sums of x^2 v."""
    total = np.empty(row.size - 6, np.float32)
    for u in range(total.size):
        near, far = row[u + 4] + row[u + 2], row[u + 6] + row[u]
        total[u] = near + np.float32(4) * (row[u + 5] + row[u + 1]) + np.float32(9) * far
    return total


@compiled
def _shrink(gradient: float, variance: float) -> float:
    """A gradient, shrunk towards zero if it is no more than some 2.5 sigmas."""
    square = gradient * gradient
    return gradient * square / (square + 2.5**2 * variance + 1e-12)


@compiled
def _measure(
    lit: Greys, dark: Greys, variance: Floats, logarithms: Floats
) -> tuple[Floats, Floats]:
    """The logarithm of lit minus dark (L, P), and its variance."""
    logarithm, noise2 = np.empty(lit.shape, np.float32), np.empty(lit.shape, np.float32)
    for line in range(lit.shape[0]):
        for x in range(lit.shape[1]):
            light, black = lit[line, x], dark[line, x]
            contrast = max(np.int32(light) - np.int32(black), np.int32(1))
            logarithm[line, x] = logarithms[contrast]
            square = np.float32(contrast * contrast)
            noise2[line, x] = (variance[light] + variance[black]) / square
    return logarithm, noise2


@compiled
def _sharpen(logarithm: Floats, noise2: Floats, across: Floats) -> None:
    """Add to the smooth gradient from line to line (L, P) what noise does not explain."""
    for line in range(1, logarithm.shape[0] - 1):
        for x in range(logarithm.shape[1]):
            slope = (logarithm[line + 1, x] - logarithm[line - 1, x]) / np.float32(2)
            variance = (noise2[line + 1, x] + noise2[line - 1, x]) / np.float32(4)
            across[line, x] += _shrink(slope - across[line, x], variance)


@compiled
def _interpolate(
    logarithm: Floats, noise2: Floats, across: Floats, shading: Floats, pixels: Indices
) -> tuple[Array, Array, Array, Array, Array]:
    """Fields of BoundaryBrightness at flat pixels (N,)."""
    before, behind = np.empty(pixels.size), np.empty(pixels.size)
    along, sideways, sigma = np.empty(pixels.size), np.empty(pixels.size), np.empty(pixels.size)
    for k in range(pixels.size):
        pixel = pixels[k]
        left, right = np.float64(logarithm[pixel]), np.float64(logarithm[pixel + 1])
        variance = 2.0 * np.float64(noise2[pixel])
        smooth = np.float64(shading[pixel])
        along[k] = smooth + _shrink(right - left - smooth, variance)
        sideways[k], sigma[k] = across[pixel], math.sqrt(variance)
        middle, half = math.exp((left + right) / 2), math.exp(along[k] / 2)
        before[k], behind[k] = middle / half, middle * half
    return before, behind, along, sideways, sigma


@compiled
def _measure_shifts(along: Array, sigma: Array, position: Array, joined: Mask) -> Array:
    """For boundaries within runs that lie on edges: the distance from the middle of their
    neighbours, divided by how much steeper the brightness is there."""
    shifts, count = np.empty(along.size), 0
    for k in range(1, along.size - 1):
        if not (joined[k - 1] and joined[k]):
            continue
        steepness = along[k] - (along[k - 1] + along[k + 1]) / 2
        if abs(steepness) > max(0.5, 5.0 * sigma[k]):
            shift = position[k] - (position[k - 1] + position[k + 1]) / 2
            shifts[count] = shift / steepness
            count += 1
    return shifts[:count].copy()


@compiled
def _shift_sigma(along: Array, across: Array, sigma: Array, blur2: float) -> Array:
    total = np.empty(along.size)
    for k in range(along.size):
        noise = min(sigma[k], abs(along[k]))
        unexplained = UNEXPLAINED**2 * (along[k] ** 2 + across[k] ** 2)
        total[k] = blur2 * math.sqrt(unexplained + noise * noise)
    return total


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
