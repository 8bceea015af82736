"""Correction of stripe boundaries that fall on an edge of the surface's own brightness.

A pixel gathers light around its centre x with a Gaussian weight of variance blur^2 (lens and
pixel). On an edge between black and white the white side contributes more: the light's centroid is
x + blur^2 grad(ln a), with a the image of the surface, and what a pixel says of the stripes holds
there. Boundaries are moved by that much, up to 0.6 px on a printed board.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from bodyscan.arrays import Array, Floats, Greys, Indices, Mask
from bodyscan.compiled import compiled
from bodyscan.geometry.crop import crop_of, ends_of
from bodyscan.stripes.scan_lines import ScanLines

USUAL_BLUR2 = 0.45
LARGEST_BLUR2 = 2.0
STEEP = 0.5
STEEP_TO_NOISE = 5.0
ENOUGH = 100
UNEXPLAINED = 0.3
SIGNIFICANCE = 2.5
MAX_SLOPE = 1.0
GENTLE_PX = 3
"""Half the window over which shading is assumed to vary linearly."""
WINDOW = 2 * GENTLE_PX + 1
LEAST_PIXELS = np.float32(11.5)
LEAST_SPREAD = np.float32(0.5)
NOTHING, ONE, TWO, THREE, FOUR, NINE = (np.float32(number) for number in (0, 1, 2, 3, 4, 9))
MAX_SHIFT_PX = 0.6
LEAST_CONTRAST = 0.02
"""Grey levels, for images with fractions of them."""


@dataclass(frozen=True, eq=False)
class Brightness:
    """How bright the surface is, as scan lines of pixels.

    logarithm: (L, P) of lit minus dark.
    noise2: (L, P), its variance.
    across: (L, P) its gradient from line to line, 1/px, pulled towards that of the shading where
        noise may explain the difference.
    shading: (L, P) its gradient along the line, smoothed over many pixels.
    """

    logarithm: Floats
    noise2: Floats
    across: Floats
    shading: Floats

    @staticmethod
    def of(images: ScanLines, variance: Floats, usable: Mask) -> Brightness:
        """variance: (256,) of each grey level. usable: (L, P) pixels on a lit surface."""
        logarithm, noise2 = np.empty((2, *images.lit.shape), np.float32)
        if images.lit.dtype == np.uint8:
            _measure(images.lit, images.dark, variance, _LOGARITHMS, logarithm, noise2)
        else:
            logarithm, noise2 = _measured_finely(images.lit, images.dark, variance)
        along, across = gentle_gradient(logarithm, usable)
        _sharpen(logarithm, noise2, across)
        return Brightness(logarithm, noise2, across, along)

    def at(self, place: Indices) -> BrightnessEdges:
        """Brightness between the pixels at flat places `place` (N,) and those after them."""
        logarithm, noise2 = self.logarithm.ravel(), self.noise2.ravel()
        return BrightnessEdges(
            *_between(logarithm, noise2, self.across.ravel(), self.shading.ravel(), place)
        )


@dataclass(frozen=True, eq=False)
class BrightnessEdges:
    """The surface's brightness where N stripe boundaries pass between two pixels of a scan line.

    before, behind: (N,) grey levels (lit minus dark) of the two pixels, brought together where
        noise may explain their difference.
    along, across: (N,) grad(ln a), 1/px, along the line and from line to line, likewise.
    sigma: (N,) the noise of `along`.
    """

    before: Array
    behind: Array
    along: Array
    across: Array
    sigma: Array

    def blur2(self, position: Array, joined: Mask) -> float:
        """blur^2, px^2, that makes boundaries at edges line up with their neighbours.

        position: (N,) px along the scan line.
        joined: (N - 1,) whether the next boundary is the next of the same run.

        If there are too few edges, a usual value: that of a lens of 0.6 px and a pixel.
        """
        shifts = _shifts_at_edges(self.along, self.sigma, position, joined)
        if shifts.size < ENOUGH:
            return USUAL_BLUR2
        return float(np.clip(-np.median(shifts), 0.0, LARGEST_BLUR2))

    def doubt(self, blur2: float) -> Array:
        """Standard deviation (N,) px of the shift blur2 * (along, across)."""
        return _doubt(self.along, self.across, self.sigma, blur2)


def without_edges_across(
    s: Floats, sigma: Floats, brightness: Brightness, blur2: float
) -> tuple[Floats, Floats]:
    """Remove from s (L, P) the pull of edges that run along the scan lines; returns s and its
    sigma.

    A pixel shows s at its light's centroid, which lies off the line by blur2 * across.
    """
    freed, doubt = np.empty(s.shape, np.float32), np.empty(s.shape, np.float32)
    s, sigma, across = map(np.ascontiguousarray, (s, sigma, brightness.across))
    _pull_out(s, sigma, across, blur2, freed, doubt)
    return freed, doubt


def gentle_gradient(image: Floats, usable: Mask) -> tuple[Floats, Floats]:
    """Gradient along and across the lines (L, P), 1/px, at usable pixels: least squares over the
    usable ones in a small window; 0 where there are too few, and at other pixels."""
    along, across = np.zeros((2, *image.shape), np.float32)
    shown = crop_of(usable)
    if shown is not None:
        _gentle(image, usable, ends_of(shown), along, across)
    return along, across


@compiled
def _gentle(
    image: Floats, usable: Mask, box: tuple[int, int, int, int], along: Floats, across: Floats
) -> None:
    """Write the gradient (L, P) line by line within a box that holds all usable pixels.

    inside, values: for the last WINDOW lines, which pixels are usable (1 or 0) and what they show,
        with zeros on both sides.
    columns: see `_sum_columns`, of both.
    """
    first, last, left, right = box
    inner = slice(GENTLE_PX, GENTLE_PX + right - left)
    inside = np.zeros((WINDOW, right - left + 2 * GENTLE_PX), np.float32)
    values = np.zeros_like(inside)
    columns = np.empty((2, 3, inside.shape[1]), np.float32)
    for line in range(first, last + GENTLE_PX):
        newest, middle = line % WINDOW, line - GENTLE_PX
        if line < last:
            _shown(
                image[line, left:right],
                usable[line, left:right],
                inside[newest, inner],
                values[newest, inner],
            )
        else:
            inside[newest], values[newest] = 0.0, 0.0
        if middle >= first:
            _sum_columns(inside, middle, columns[0])
            _sum_columns(values, middle, columns[1])
            _fit_windows(
                columns,
                usable[middle, left:right],
                along[middle, left:right],
                across[middle, left:right],
            )


@compiled
def _shown(image: Floats, usable: Mask, inside: Floats, values: Floats) -> None:
    """Write, for a line (P,), which pixels are usable (1 or 0) and their values, else 0."""
    for u in range(image.size):
        inside[u] = usable[u]
        values[u] = image[u] * inside[u]


@compiled
def _sum_columns(rows: Floats, middle: int, sums: Floats) -> None:
    """Write sums (3, P) of v, y v and y^2 v over columns of WINDOW lines, y counted from the middle
    line; line k is in row k mod WINDOW."""
    above3, above2, above = (
        rows[(middle - 3) % WINDOW],
        rows[(middle - 2) % WINDOW],
        rows[(middle - 1) % WINDOW],
    )
    here, below = rows[middle % WINDOW], rows[(middle + 1) % WINDOW]
    below2, below3 = rows[(middle + 2) % WINDOW], rows[(middle + 3) % WINDOW]
    for u in range(here.size):
        one, two, three = below[u] + above[u], below2[u] + above2[u], below3[u] + above3[u]
        sums[0, u] = here[u] + one + two + three
        sums[2, u] = one + FOUR * two + NINE * three
        one, two, three = below[u] - above[u], below2[u] - above2[u], below3[u] - above3[u]
        sums[1, u] = one + TWO * two + THREE * three


@compiled
def _fit_windows(columns: Floats, usable: Mask, along: Floats, across: Floats) -> None:
    """Write the gradient of a line (P,) from the sums over its columns, (2, 3, P + 2 GENTLE_PX).

    Intermediate results have arrays of their own: only then does the compiler know that they do not
    overlap, and computes eight places at once.
    """
    ones, ones_y, values = columns[0, 0], columns[0, 1], columns[1, 0]
    n, sum_x, sum_xx = _even(ones), _odd(ones), _square(ones)
    sum_y, sum_xy, sum_yy = _even(ones_y), _odd(ones_y), _even(columns[0, 2])
    sum_v, sum_xv, sum_yv = _even(values), _odd(values), _even(columns[1, 1])
    by_x, by_y, area = np.empty_like(n), np.empty_like(n), np.empty_like(n)
    for u in range(usable.size):
        share = ONE / n[u]
        x, y, v = sum_x[u] * share, sum_y[u] * share, sum_v[u] * share
        xx, yy = sum_xx[u] * share - x * x, sum_yy[u] * share - y * y
        xy = sum_xy[u] * share - x * y
        xv, yv = sum_xv[u] * share - x * v, sum_yv[u] * share - y * v
        area[u] = xx * yy - xy * xy
        by_x[u], by_y[u] = (yy * xv - xy * yv) / area[u], (xx * yv - xy * xv) / area[u]
    for u in range(usable.size):
        known = usable[u] & (n[u] >= LEAST_PIXELS) & (area[u] > LEAST_SPREAD)
        along[u], across[u] = (by_x[u], by_y[u]) if known else (NOTHING, NOTHING)


@compiled
def _even(row: Floats) -> Floats:
    """Sums (P,) of v over WINDOW places of a row (P + 2 GENTLE_PX,)."""
    total = np.empty(row.size - 2 * GENTLE_PX, np.float32)
    for u in range(total.size):
        near, far = row[u + 2] + row[u + 4], row[u] + row[u + 6]
        total[u] = row[u + 3] + near + row[u + 1] + row[u + 5] + far
    return total


@compiled
def _odd(row: Floats) -> Floats:
    """The same sums of x v, with x counted from the window's middle."""
    total = np.empty(row.size - 2 * GENTLE_PX, np.float32)
    for u in range(total.size):
        near, far = row[u + 4] - row[u + 2], row[u + 6] - row[u]
        total[u] = near + TWO * (row[u + 5] - row[u + 1]) + THREE * far
    return total


@compiled
def _square(row: Floats) -> Floats:
    """The same sums of x^2 v."""
    total = np.empty(row.size - 2 * GENTLE_PX, np.float32)
    for u in range(total.size):
        near, far = row[u + 4] + row[u + 2], row[u + 6] + row[u]
        total[u] = near + FOUR * (row[u + 5] + row[u + 1]) + NINE * far
    return total


@compiled
def _significant(gradient: float, variance: float) -> float:
    """A gradient, reduced towards zero if noise may explain it."""
    square = gradient * gradient
    return gradient * square / (square + SIGNIFICANCE**2 * variance + 1e-12)


def _measured_finely(lit: Greys, dark: Greys, variance: Floats) -> tuple[Floats, Floats]:
    """As `_measure`, for images with fractions of grey levels."""
    contrast = np.maximum(lit - dark, LEAST_CONTRAST).astype(np.float32)
    at_lit, at_dark = (variance[grey.astype(np.uint8)] for grey in (lit, dark))
    return np.log(contrast), (at_lit + at_dark) / np.square(contrast)


@compiled
def _measure(
    lit: Greys,
    dark: Greys,
    variance: Floats,
    logarithms: Floats,
    logarithm: Floats,
    noise2: Floats,
) -> None:
    """Write the logarithm of lit minus dark (L, P), and its variance."""
    for line in range(lit.shape[0]):
        for place in range(lit.shape[1]):
            light, black = lit[line, place], dark[line, place]
            contrast = max(np.int32(light) - np.int32(black), np.int32(1))
            logarithm[line, place] = logarithms[contrast]
            square = np.float32(contrast * contrast)
            noise2[line, place] = (variance[light] + variance[black]) / square


@compiled
def _sharpen(logarithm: Floats, noise2: Floats, across: Floats) -> None:
    """Add to the smooth gradient from line to line (L, P) what noise does not explain."""
    for line in range(1, logarithm.shape[0] - 1):
        for place in range(logarithm.shape[1]):
            seen = (logarithm[line + 1, place] - logarithm[line - 1, place]) / np.float32(2)
            variance = (noise2[line + 1, place] + noise2[line - 1, place]) / np.float32(4)
            across[line, place] += _significant(seen - across[line, place], variance)


@compiled
def _between(
    logarithm: Floats, noise2: Floats, across: Floats, shading: Floats, place: Indices
) -> tuple[Array, Array, Array, Array, Array]:
    """Fields of BrightnessEdges at flat places (N,)."""
    before, behind = np.empty(place.size), np.empty(place.size)
    along, sideways, sigma = np.empty(place.size), np.empty(place.size), np.empty(place.size)
    for k in range(place.size):
        at = place[k]
        one, other = np.float64(logarithm[at]), np.float64(logarithm[at + 1])
        variance = 2.0 * np.float64(noise2[at])
        gentle = np.float64(shading[at])
        along[k] = gentle + _significant(other - one - gentle, variance)
        sideways[k], sigma[k] = across[at], math.sqrt(variance)
        middle, half = math.exp((one + other) / 2), math.exp(along[k] / 2)
        before[k], behind[k] = middle / half, middle * half
    return before, behind, along, sideways, sigma


@compiled
def _shifts_at_edges(along: Array, sigma: Array, position: Array, joined: Mask) -> Array:
    """For boundaries within runs that lie on edges: the distance from the middle of their
    neighbours, divided by how much steeper the brightness is there."""
    shifts, count = np.empty(along.size), 0
    for k in range(1, along.size - 1):
        if not (joined[k - 1] and joined[k]):
            continue
        steepness = along[k] - (along[k - 1] + along[k + 1]) / 2
        if abs(steepness) > max(STEEP, STEEP_TO_NOISE * sigma[k]):
            bend = position[k] - (position[k - 1] + position[k + 1]) / 2
            shifts[count] = bend / steepness
            count += 1
    return shifts[:count].copy()


@compiled
def _doubt(along: Array, across: Array, sigma: Array, blur2: float) -> Array:
    doubt = np.empty(along.size)
    for k in range(along.size):
        noise = min(sigma[k], abs(along[k]))
        unexplained = UNEXPLAINED**2 * (along[k] ** 2 + across[k] ** 2)
        doubt[k] = blur2 * math.sqrt(unexplained + noise * noise)
    return doubt


@compiled
def _pull_out(
    s: Floats, sigma: Floats, across: Floats, blur2: float, freed: Floats, doubt: Floats
) -> None:
    """`without_edges_across`, written to freed and doubt (L, P)."""
    lines = s.shape[0]
    for line in range(lines):
        for place in range(s.shape[1]):
            here = s[line, place]
            freed[line, place] = doubt[line, place] = np.nan
            if math.isnan(here):
                continue
            above = s[line - 1, place] if line > 0 else np.float32(np.nan)
            below = s[line + 1, place] if line + 1 < lines else np.float32(np.nan)
            slope = (below - above) / np.float32(2)
            # At the end of the surface only the change on the inner side is known.
            if math.isnan(slope):
                slope = here - above if math.isnan(below) else below - here
            pull = 0.0
            if abs(slope) < MAX_SLOPE:
                shift = min(max(blur2 * across[line, place], -MAX_SHIFT_PX), MAX_SHIFT_PX)
                pull = slope * shift
            freed[line, place] = here - pull
            doubt[line, place] = math.sqrt(
                sigma[line, place] ** 2 + (2.0 * UNEXPLAINED * pull) ** 2
            )


_LOGARITHMS = np.log(np.maximum(np.arange(256), 1)).astype(np.float32)
