"""The stripe coordinate s of every pixel, from the boundaries on either side of it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bodyscan.arrays import Array, Floats, Indices, Mask
from bodyscan.compiled import compiled
from bodyscan.stripes.boundaries import MIN_STRIPE_PX, Boundaries

SMOOTHERS = (
    np.array([-3.0, 12.0, 17.0, 12.0, -3.0]) / 35.0,
    np.array([-2.0, 3.0, 6.0, 7.0, 6.0, 3.0, -2.0]) / 21.0,
)
"""Local quadratic fits to 5 and to 7 equally spaced values (Savitzky and Golay 1964)."""

REACH_PX = 6.0
MAX_STRAY = 4.0
SLACK = 0.15
BEYOND = 0.4
"""How far s is extrapolated past the last boundary of a run, in stripes."""
BEYOND_DOUBT = 3.0
"""Factor on the sigma of s there."""
MAX_PULL = 0.05
"""More than blur does to s on any smooth surface."""

SHARED, SHARED_BY_RUNS = 1.4, 2.4
"""Stripes over which the noise of s is alike. One stripe apart, two pixels between boundaries share a
quarter of it, and 0.65 if the boundaries were smoothed; two apart nothing, and 0.14: a line that falls
to nothing at these distances is nowhere off by more than a tenth."""


def interpolate_stripes(
    boundaries: Boundaries,
    codes: NDArray[np.int32],
    usable: Mask,
    rough: Mask | None = None,
) -> tuple[Floats, Floats]:
    """s and its standard deviation, (L, P) each, NaN where there is none.

    rough: (N,) boundaries on relief that a smooth run would flatten: they are left in place.

    Between two boundaries s is a cubic with slopes from the boundaries around them (Hermite). Past
    the last boundary of a run it continues a little with the slope there.
    """
    s = np.full(codes.shape, np.nan, np.float32)
    sigma = s.copy()
    if boundaries.joined.any():
        found = _Segments.of(boundaries, rough)
        segments = (found.start, found.width, found.index, found.rise, found.sigma)
        bends = (found.slope_in, found.slope_out, found.pull)
        places = (boundaries.line, boundaries.before)
        _fill(s, sigma, codes, usable, *places, segments, bends, SLACK)
    return s, sigma


def alike_along_lines(boundaries: Boundaries) -> float:
    """Distance along a line, px, within which pixels share noise: all between two boundaries, and
    more where those share it because a run was smoothed. 0 without stripes."""
    width = np.diff(boundaries.position)[boundaries.joined]
    width = width[width >= MIN_STRIPE_PX]
    if not len(width):
        return 0.0
    usual = float(np.median(width))
    smoothed = (len(SMOOTHERS[0]) - 1) * usual < 2 * REACH_PX
    return (SHARED_BY_RUNS if smoothed else SHARED) * usual


@dataclass(frozen=True, eq=False)
class _Segments:
    """s on a scan line between boundaries j and j + 1: NaN if they are not joined.

    start: place of boundary j, px.
    width: distance to the next, px.
    index: s at boundary j.
    rise: change of s to the next.
    slope_in, slope_out: ds per px at both ends.
    pull: what blur adds to s where s bends, blur^2 / 2 times its second derivative.
    sigma: of s.
    """

    start: Array
    width: Array
    index: Array
    rise: Array
    slope_in: Array
    slope_out: Array
    pull: Array
    sigma: Array

    @staticmethod
    def of(boundaries: Boundaries, rough: Mask | None = None) -> _Segments:
        smooth = boundaries.joined
        if rough is not None:
            smooth = smooth & ~(rough[1:] | rough[:-1])
        position, sigma_px = smooth_runs(boundaries, smooth)
        width = np.where(boundaries.joined, np.diff(position), np.nan)
        width[width < MIN_STRIPE_PX] = np.nan
        rise = np.diff(boundaries.index).astype(float)
        secant = rise / width
        slope_in, slope_out = end_slopes(secant, width)
        pull = np.clip(0.5 * boundaries.blur2 * (slope_out - slope_in) / width, -MAX_PULL, MAX_PULL)
        variance = sigma_px * sigma_px
        sigma = np.abs(secant) * np.sqrt((variance[1:] + variance[:-1]) / 2)
        start, index = position[:-1], boundaries.index[:-1].astype(float)
        return _Segments(start, width, index, rise, slope_in, slope_out, pull, sigma)


@compiled
def _fill(
    s: Floats,
    sigma: Floats,
    codes: NDArray[np.int32],
    usable: Mask,
    line: Indices,
    before: Indices,
    segments: tuple[Array, ...],
    bends: tuple[Array, ...],
    slack: float,
) -> None:
    """Write s and sigma (L, P) of usable pixels from the segments they lie in; beyond a run's ends,
    from its last segment, the one before the pixel in preference to the one after.

    line, before: (N,) of the boundaries.
    segments, bends: (N - 1,) each, see `_Segments`.
    slack: by how many stripes s may leave the code's stripe.
    """
    last, count = -1, line.size
    for row in range(codes.shape[0]):
        for place in range(codes.shape[1]):
            while last + 1 < count and (
                line[last + 1] < row or (line[last + 1] == row and before[last + 1] < place)
            ):
                last += 1
            if not usable[row, place]:
                continue
            code, passed = codes[row, place], last >= 0 and line[last] == row
            value, doubt = np.nan, np.nan
            if passed and last + 1 < count:
                value, doubt = _within(place, code, last, segments, bends, SLACK)
            if passed and last >= 1 and math.isnan(value):
                value, doubt = _beside(place, code, last - 1, segments, bends, SLACK)
            if last + 2 < count and line[last + 1] == row and math.isnan(value):
                value, doubt = _beside(place, code, last + 1, segments, bends, SLACK)
            s[row, place], sigma[row, place] = value, doubt


@compiled
def _within(
    place: int,
    code: int,
    k: int,
    segments: tuple[Array, ...],
    bends: tuple[Array, ...],
    slack: float,
) -> tuple[float, float]:
    """s and its standard deviation at a place (px) between the boundaries of segment k, or NaN."""
    start, width, index, rise, sigma = segments
    slope_in, slope_out, pull = bends
    x, secant = place - start[k], rise[k] / width[k]
    square = (3.0 * secant - 2.0 * slope_in[k] - slope_out[k]) / width[k]
    cube = (slope_in[k] + slope_out[k] - 2.0 * secant) / (width[k] * width[k])
    value = ((cube * x + square) * x + slope_in[k]) * x + index[k] - pull[k]
    return _credible(value, sigma[k], code, index[k] + 0.5 * rise[k], slack)


@compiled
def _beside(
    place: int,
    code: int,
    k: int,
    segments: tuple[Array, ...],
    bends: tuple[Array, ...],
    slack: float,
) -> tuple[float, float]:
    """s and its standard deviation at a place (px) before or after segment k, or NaN: its bend
    continues, and the doubt grows by what that adds."""
    start, width, index, rise, sigma = segments
    slope_in, slope_out, pull = bends
    x, base, slope = place - start[k], index[k] - pull[k], slope_in[k]
    if x > 0.5 * width[k]:
        x, base, slope = x - width[k], base + rise[k], slope_out[k]
    bending = 0.5 * x * x * (slope_out[k] - slope_in[k]) / width[k]
    doubt = math.sqrt((BEYOND_DOUBT * sigma[k]) ** 2 + bending * bending)
    return _credible(base + x * slope + bending, doubt, code, index[k] + 0.5 * rise[k], slack)


@compiled
def _credible(
    value: float, doubt: float, code: int, middle: float, slack: float
) -> tuple[float, float]:
    """Both values, or NaN if the pixel's code disagrees or s leaves the segment (`middle` is s at
    its middle) by more than a part of a stripe."""
    if abs(value - code - 0.5) < 0.5 + slack and abs(value - middle) < 0.5 + BEYOND:
        return value, doubt
    return np.nan, np.nan


@compiled
def end_slopes(secant: Array, width: Array) -> tuple[Array, Array]:
    """Slopes of s at both ends of every segment, from the neighbouring segments; the segment's own
    secant if there are none.

    Within a run the slope at a boundary is that of the parabola through it and its neighbours; at a
    run's end the parabola of the one segment is continued. Segments in which s runs the other way
    say nothing about this one.
    """
    count = secant.size
    slope_in, slope_out = np.full(count, np.nan), np.full(count, np.nan)
    for k in range(1, count):
        if secant[k - 1] * secant[k] > 0.0:
            both = width[k - 1] * secant[k] + width[k] * secant[k - 1]
            slope_in[k] = slope_out[k - 1] = both / (width[k - 1] + width[k])
    for k in range(count):
        first, last = slope_in[k], slope_out[k]
        slope_in[k] = _completed(first, last, secant[k])
        slope_out[k] = _completed(last, first, secant[k])
    return slope_in, slope_out


@compiled
def _completed(slope: float, other: float, secant: float) -> float:
    """The slope at one end; if unknown, of the parabola with slope `other` at the other end."""
    if not math.isnan(slope):
        return slope
    return secant if math.isnan(other) else 2.0 * secant - other


def smooth_runs(boundaries: Boundaries, joined: Mask) -> tuple[Array, Array]:
    """Positions and their sigmas, px, after a local quadratic fit along each unbroken run.

    Along a run the index counts evenly, so the fit of place against index is a fixed filter. It
    reaches no farther than about 6 px and not past the run's ends; a boundary that it would move by
    more than noise explains is left in place.
    """
    position, sigma = boundaries.position.copy(), boundaries.sigma_px.copy()
    for weights in SMOOTHERS:
        _smooth(boundaries.position, boundaries.sigma_px, joined, weights, position, sigma)
    return position, sigma


@compiled
def _smooth(
    seen: Array,
    sigma_px: Array,
    joined: Mask,
    weights: Array,
    position: Array,
    sigma: Array,
) -> None:
    """Apply one filter of `smooth_runs`; overwrites position and sigma (N,) where it fits."""
    half = weights.size // 2
    share = math.sqrt(np.sum(weights * weights))
    run = 0  # how many boundaries before this one belong to its run
    for last in range(1, seen.size):
        run = run + 1 if joined[last - 1] else 0
        if run < 2 * half or seen[last] - seen[last - 2 * half] >= 2 * REACH_PX:
            continue
        middle, fitted = last - half, 0.0
        for k in range(weights.size):
            fitted += weights[k] * seen[last - 2 * half + k]
        if abs(fitted - seen[middle]) < MAX_STRAY * sigma_px[middle]:
            position[middle], sigma[middle] = fitted, sigma_px[middle] * share
