"""The stripe coordinate s of every pixel, from the boundaries on either side of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bodyscan.capture.boundaries import MIN_STRIPE_PX, Boundaries

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]
Indices = NDArray[np.integer[Any]]

SMOOTHERS = (
    np.array([-3.0, 12.0, 17.0, 12.0, -3.0]) / 35.0,
    np.array([-2.0, 3.0, 6.0, 7.0, 6.0, 3.0, -2.0]) / 21.0,
)
"""Local quadratic fits to 5 and to 7 equally spaced values (Savitzky and Golay 1964)."""

REACH_PX = 6.0
MAX_STRAY = 4.0
SLACK = 0.15
BEYOND = 0.4
"""How far s is continued past the last boundary of a run, stripes."""
BEYOND_DOUBT = 3.0
"""How much less is known of s there."""
MAX_PULL = 0.05
"""More than blur does to s on any smooth surface."""


def interpolate_stripes(
    boundaries: Boundaries, codes: NDArray[np.int32], usable: Mask
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """s and its standard deviation, (L, P) each, NaN where there is none.

    Between two boundaries s is a cubic with the slopes that the boundaries around them tell
    (Hermite's). Past the last boundary of a run it goes on with the slope there, a little way.
    """
    s = np.full(codes.shape, np.nan, np.float32)
    sigma = s.copy()
    joined = boundaries.joined
    if not joined.any():
        return s, sigma
    stripes = _Segments.of(boundaries, joined)
    last = _last_boundary(boundaries, codes.shape)
    wanted = np.flatnonzero(usable & (last >= 0))
    stripes.fill(s, sigma, wanted, last.ravel()[wanted], codes, stripes.within)
    for neighbour in (-1, 1):
        wanted = np.flatnonzero(usable & np.isnan(s))
        segment = last.ravel()[wanted] + neighbour
        within = (segment >= 0) & (segment < len(joined))
        wanted, segment = wanted[within], segment[within]
        here = boundaries.line[segment + (neighbour < 0)] == wanted // codes.shape[1]
        stripes.fill(s, sigma, wanted[here], segment[here], codes, stripes.beside)
    return s, sigma


def _last_boundary(boundaries: Boundaries, shape: tuple[int, ...]) -> NDArray[np.int32]:
    """(L, P): which boundary was last crossed at or before each pixel, over all lines; or -1."""
    crossed = np.zeros(shape, np.int32)
    crossed[boundaries.line, boundaries.before + 1] = 1
    return np.cumsum(crossed.ravel(), dtype=np.int32).reshape(shape) - 1


@dataclass(frozen=True, eq=False)
class _Segments:
    """s on a scan line between boundaries j and j + 1: NaN if they are not joined.

    start: place of boundary j, px.  width: to the next, px.  index: s at boundary j.  rise: what s
    gains to the next.  slope_in, slope_out: ds per px at both ends.  pull: what blur adds to s
    where s bends, blur^2 / 2 times its second derivative.  sigma: of s.
    """

    start: Floats
    width: Floats
    index: Floats
    rise: Floats
    slope_in: Floats
    slope_out: Floats
    pull: Floats
    sigma: Floats

    @staticmethod
    def of(boundaries: Boundaries, joined: Mask) -> _Segments:
        position, sigma_px = smoothed(boundaries, joined)
        width = np.where(joined, np.diff(position), np.nan)
        width[width < MIN_STRIPE_PX] = np.nan
        rise = np.diff(boundaries.index).astype(float)
        slope_in, slope_out = end_slopes(rise / width, width)
        pull = 0.5 * boundaries.blur2 * (slope_out - slope_in) / width
        pull = np.clip(pull, -MAX_PULL, MAX_PULL)
        sigma = np.abs(rise / width) * np.sqrt((sigma_px[1:] ** 2 + sigma_px[:-1] ** 2) / 2)
        start, index = position[:-1], boundaries.index[:-1].astype(float)
        return _Segments(start, width, index, rise, slope_in, slope_out, pull, sigma)

    def within(self, segment: Indices, place: Indices) -> tuple[Floats, Floats]:
        """s and its standard deviation at places (px) between a segment's boundaries."""
        width, secant = self.width, self.rise / self.width
        square = (3.0 * secant - 2.0 * self.slope_in - self.slope_out) / width
        cube = (self.slope_in + self.slope_out - 2.0 * secant) / width**2
        x = place - self.start[segment]
        value = cube[segment] * x
        value += square[segment]
        value *= x
        value += self.slope_in[segment]
        value *= x
        value += (self.index - self.pull)[segment]
        return value, self.sigma[segment]

    def beside(self, segment: Indices, place: Indices) -> tuple[Floats, Floats]:
        """s and its standard deviation at places (px) before or behind a segment: its bend goes on,
        and s is doubted by as much as that adds."""
        width = self.width[segment]
        x = place - self.start[segment]
        behind = x > 0.5 * width
        x = np.where(behind, x - width, x)
        slope_in, slope_out = self.slope_in[segment], self.slope_out[segment]
        bending = 0.5 * x**2 * (slope_out - slope_in) / width
        value = self.index[segment] - self.pull[segment] + x * np.where(behind, slope_out, slope_in)
        value += bending + np.where(behind, self.rise[segment], 0.0)
        return value, np.hypot(BEYOND_DOUBT * self.sigma[segment], bending)

    def fill(
        self,
        s: NDArray[np.float32],
        sigma: NDArray[np.float32],
        pixels: Indices,
        segment: Indices,
        codes: NDArray[np.int32],
        evaluate: Callable[[Indices, Indices], tuple[Floats, Floats]],
    ) -> None:
        """Writes s and sigma at flat `pixels` from their segments, where the code agrees and the
        segment is left by no more than a part of a stripe. evaluate: `within` or `beside`."""
        segment = np.minimum(segment, len(self.start) - 1)
        value, spread = evaluate(segment, pixels % s.shape[1])
        off_code = np.abs(value - codes.ravel()[pixels] - 0.5)
        middle = self.index + 0.5 * self.rise
        off_segment = np.abs(value - middle[segment])
        takes = (off_code < 0.5 + SLACK) & (off_segment < 0.5 + BEYOND)
        s.ravel()[pixels[takes]] = value[takes]
        sigma.ravel()[pixels[takes]] = spread[takes]


def end_slopes(secant: Floats, width: Floats) -> tuple[Floats, Floats]:
    """Slopes of s at both ends of every segment from the segments beside it; their own secant where
    there are none.

    Within a run the slope at a boundary is that of the parabola through it and its neighbours; at
    a run's end the parabola of the one segment goes on. Segments in which s runs the other way
    tell nothing of this one.
    """
    nothing = np.array([np.nan])
    secant_before, width_before = np.r_[nothing, secant[:-1]], np.r_[nothing, width[:-1]]
    slope = (width_before * secant + width * secant_before) / (width_before + width)
    slope = np.where(secant_before * secant > 0.0, slope, np.nan)
    slope_out = np.r_[slope[1:], nothing]
    return _completed(slope, slope_out, secant), _completed(slope_out, slope, secant)


def _completed(slope: Floats, other: Floats, secant: Floats) -> Floats:
    """Slopes at one end; where unknown, of the parabola with slope `other` at the other end."""
    slope = np.where(np.isnan(slope), 2.0 * secant - other, slope)
    return np.where(np.isnan(slope), secant, slope)


def smoothed(boundaries: Boundaries, joined: Mask) -> tuple[Floats, Floats]:
    """Positions and their sigmas, px, after a local quadratic fit along each unbroken run.

    Along a run the index counts evenly, so the fit of place against index is a fixed filter. It
    reaches no further than about 6 px and not past the run's ends; a boundary that it would move
    by more than noise explains stays where it was seen.
    """
    position, sigma = boundaries.position.copy(), boundaries.sigma_px.copy()
    for weights in SMOOTHERS:
        half = len(weights) // 2
        if len(position) < len(weights):
            continue
        inner = slice(half, len(position) - half)
        broken = np.concatenate([[0], np.cumsum(~joined)])
        whole = broken[2 * half :] == broken[: -2 * half]
        seen = boundaries.position
        whole &= seen[2 * half :] - seen[: -2 * half] < 2 * REACH_PX
        fitted = np.convolve(seen, weights, mode="valid")
        moved = np.abs(fitted - seen[inner])
        take = whole & (moved < MAX_STRAY * boundaries.sigma_px[inner])
        position[inner][take] = fitted[take]
        sigma[inner][take] = boundaries.sigma_px[inner][take] * np.linalg.norm(weights)
    return position, sigma
