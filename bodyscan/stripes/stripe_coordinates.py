"""The stripe coordinate s of every pixel, interpolated along runs of boundaries.

Also how far boundaries scatter about smooth runs, compared with their sigmas. Grey noise is measured
where two images show the same thing. But JPEG errs with the content of an image, exposures vary from
a pattern to its inverse, and pixels of projector and camera beat: each shifts a boundary relative to
its neighbours, and all of it shows here.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from bodyscan.arrays import Array, Floats, Indices, Mask
from bodyscan.compiled import compiled
from bodyscan.geometry.robust import SIGMAS_PER_MEDIAN
from bodyscan.stripes.boundaries import MIN_STRIPE_PX, PARABOLA_RESIDUAL, Boundaries

SMOOTHERS = (
    np.array([-3.0, 12.0, 17.0, 12.0, -3.0]) / 35.0,
    np.array([-2.0, 3.0, 6.0, 7.0, 6.0, 3.0, -2.0]) / 21.0,
)
"""Local quadratic fits to 5 and to 7 equally spaced values (Savitzky and Golay 1964)."""
REACH_PX = 6.0
"""Greatest distance over which a run is smoothed."""


def interpolate_stripes(
    boundaries: Boundaries, codes: NDArray[np.int32], usable: Mask
) -> tuple[Floats, Floats]:
    """Interpolate s and its standard deviation, (L, P) each, NaN where there is none.

    Between two boundaries s is a cubic with slopes from the boundaries around them (Hermite). Past
    the last boundary of a run it is extrapolated a little with the slope there.
    """
    s = np.full(codes.shape, np.nan, np.float32)
    sigma = s.copy()
    if boundaries.joined.any():
        segments = _fit_segments(boundaries)
        _fill(s, sigma, codes, usable, boundaries.line, boundaries.before, segments)
    return s, sigma


def measure_correlation(boundaries: Boundaries) -> float:
    """Compute the distance along a line, px, within which pixels share noise; 0 without stripes.

    A linear fall to zero at 1.4 stripes (2.4 if boundaries were smoothed) is right to a tenth.
    """
    width = np.diff(boundaries.position)[boundaries.joined]
    width = width[width >= MIN_STRIPE_PX]
    if not len(width):
        return 0.0
    median = float(np.median(width))
    smoothed = (len(SMOOTHERS[0]) - 1) * median < 2 * REACH_PX
    return (2.4 if smoothed else 1.4) * median


def _fit_segments(boundaries: Boundaries) -> tuple[Array, ...]:
    """Fit s on scan lines between boundaries j and j + 1; NaN if they are not joined.

    Returns, (N - 1,) each: position of boundary j and distance to the next, px; s at j and its change
    to the next; sigma of s; ds per px at both ends; and what blur adds to s on a curved surface, blur^2
    / 2 times its second derivative.
    """
    position, sigma_px = smooth_runs(boundaries)
    width = np.where(boundaries.joined, np.diff(position), np.nan)
    width[width < MIN_STRIPE_PX] = np.nan
    rise = np.diff(boundaries.index).astype(float)
    secant = rise / width
    slope_in, slope_out = estimate_end_slopes(secant, width)
    # More than 0.05 is more than blur does to s on any smooth surface.
    bias = np.clip(0.5 * boundaries.blur2 * (slope_out - slope_in) / width, -0.05, 0.05)
    variance = sigma_px * sigma_px
    sigma = np.abs(secant) * np.sqrt((variance[1:] + variance[:-1]) / 2)
    start, index = position[:-1], boundaries.index[:-1].astype(float)
    return start, width, index, rise, sigma, slope_in, slope_out, bias


@compiled
def _fill(
    s: Floats,
    sigma: Floats,
    codes: NDArray[np.int32],
    usable: Mask,
    line: Indices,
    before: Indices,
    segments: tuple[Array, ...],
) -> None:
    """Write s and sigma (L, P) of usable pixels from the segments they lie in; beyond a run's ends,
    from its last segment, the one before the pixel in preference to the one after.

    line, before: (N,) of the boundaries. segments: see `_fit_segments`.
    """
    last, count = -1, line.size
    for row in range(codes.shape[0]):
        for x in range(codes.shape[1]):
            while last + 1 < count and (
                line[last + 1] < row or (line[last + 1] == row and before[last + 1] < x)
            ):
                last += 1
            if not usable[row, x]:
                continue
            code, passed = codes[row, x], last >= 0 and line[last] == row
            value, error = np.nan, np.nan
            if passed and last + 1 < count:
                value, error = _interpolate(x, code, last, segments)
            if passed and last >= 1 and math.isnan(value):
                value, error = _extrapolate(x, code, last - 1, segments)
            if last + 2 < count and line[last + 1] == row and math.isnan(value):
                value, error = _extrapolate(x, code, last + 1, segments)
            s[row, x], sigma[row, x] = value, error


@compiled
def _interpolate(pixel: int, code: int, k: int, segments: tuple[Array, ...]) -> tuple[float, float]:
    """s and its standard deviation at a pixel between the boundaries of segment k, or NaN."""
    start, width, index, rise, sigma, slope_in, slope_out, bias = segments
    x, secant = pixel - start[k], rise[k] / width[k]
    square = (3.0 * secant - 2.0 * slope_in[k] - slope_out[k]) / width[k]
    cube = (slope_in[k] + slope_out[k] - 2.0 * secant) / (width[k] * width[k])
    value = ((cube * x + square) * x + slope_in[k]) * x + index[k] - bias[k]
    return _accept(value, sigma[k], code, index[k] + 0.5 * rise[k])


@compiled
def _extrapolate(pixel: int, code: int, k: int, segments: tuple[Array, ...]) -> tuple[float, float]:
    """s and its standard deviation at a pixel before or after segment k, or NaN; the continued
    curvature counts as an error besides three sigmas of the segment."""
    start, width, index, rise, sigma, slope_in, slope_out, bias = segments
    x, base, slope = pixel - start[k], index[k] - bias[k], slope_in[k]
    if x > 0.5 * width[k]:
        x, base, slope = x - width[k], base + rise[k], slope_out[k]
    curvature = 0.5 * x * x * (slope_out[k] - slope_in[k]) / width[k]
    error = math.sqrt((3.0 * sigma[k]) ** 2 + curvature * curvature)
    return _accept(base + x * slope + curvature, error, code, index[k] + 0.5 * rise[k])


@compiled
def _accept(value: float, error: float, code: int, middle: float) -> tuple[float, float]:
    """Both values, or NaN if s is 0.15 stripes outside the pixel's code or 0.4 outside the segment.

    middle: s in the middle of the segment.
    """
    if abs(value - code - 0.5) < 0.65 and abs(value - middle) < 0.9:
        return value, error
    return np.nan, np.nan


@compiled
def estimate_end_slopes(secant: Array, width: Array) -> tuple[Array, Array]:
    """Estimate the slopes of s at both ends of every segment from the neighbouring segments.

    Within a run the slope is that of the parabola through a boundary and its neighbours; at its
    ends the parabola is continued; a segment alone has its secant's slope.
    """
    count = secant.size
    slope_in, slope_out = np.full(count, np.nan), np.full(count, np.nan)
    for k in range(1, count):
        if secant[k - 1] * secant[k] > 0.0:
            both = width[k - 1] * secant[k] + width[k] * secant[k - 1]
            slope_in[k] = slope_out[k - 1] = both / (width[k - 1] + width[k])
    for k in range(count):
        first, last = slope_in[k], slope_out[k]
        slope_in[k] = _continue_slope(first, last, secant[k])
        slope_out[k] = _continue_slope(last, first, secant[k])
    return slope_in, slope_out


@compiled
def _continue_slope(slope: float, other: float, secant: float) -> float:
    """The slope at one end; if unknown, of the parabola with slope `other` at the other end."""
    if not math.isnan(slope):
        return slope
    return secant if math.isnan(other) else 2.0 * secant - other


def smooth_runs(boundaries: Boundaries) -> tuple[Array, Array]:
    """Smooth positions by a local quadratic fit of position against index along each unbroken run;
    returns them and their sigmas, px.

    The fit reaches no farther than about 6 px; a boundary that it would move by more than four
    sigmas is left in place.
    """
    position, sigma = boundaries.position.copy(), boundaries.sigma_px.copy()
    for weights in SMOOTHERS:
        measured = boundaries.position, boundaries.sigma_px, boundaries.joined
        _smooth(*measured, weights, position, sigma)
    return position, sigma


@compiled
def _smooth(
    measured: Array, sigma_px: Array, joined: Mask, weights: Array, position: Array, sigma: Array
) -> None:
    """Apply one filter of `smooth_runs`; overwrites position and sigma (N,) where it fits."""
    half = weights.size // 2
    gain = math.sqrt(np.sum(weights * weights))
    run = 0  # how many boundaries before this one belong to its run
    for last in range(1, measured.size):
        run = run + 1 if joined[last - 1] else 0
        if run < 2 * half or measured[last] - measured[last - 2 * half] >= 2 * REACH_PX:
            continue
        middle, fitted = last - half, 0.0
        for k in range(weights.size):
            fitted += weights[k] * measured[last - 2 * half + k]
        if abs(fitted - measured[middle]) < 4.0 * sigma_px[middle]:
            position[middle], sigma[middle] = fitted, sigma_px[middle] * gain


def estimate_scatter(boundaries: Boundaries) -> float:
    """Estimate the ratio of observed to predicted distances from a parabola through five boundaries
    of a run, robustly; 1 if it is not clearly more, or there are too few."""
    position, joined = boundaries.position, boundaries.joined
    if len(joined) < 1000:
        return 1.0
    near = position[4:] - position[:-4] < 2.0 * REACH_PX
    first = np.flatnonzero(near & sliding_window_view(joined, 4).all(axis=1))
    first = first[:: max(1, len(first) // 20_000)]
    if len(first) < 1000:
        return 1.0
    residual = sliding_window_view(position, 5)[first] @ PARABOLA_RESIDUAL
    variance = sliding_window_view(boundaries.sigma_px, 5)[first] ** 2 @ PARABOLA_RESIDUAL**2
    ratio = SIGMAS_PER_MEDIAN * float(np.median(np.abs(residual / np.sqrt(variance))))
    return ratio if ratio > 1.2 else 1.0  # less may be due to the surface
