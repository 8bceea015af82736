"""The stripe coordinate s of every pixel, from the boundaries on either side of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bodyscan.capture.boundaries import MIN_STRIPE_PX, Boundaries

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

SMOOTHERS = (
    np.array([-3.0, 12.0, 17.0, 12.0, -3.0]) / 35.0,
    np.array([-2.0, 3.0, 6.0, 7.0, 6.0, 3.0, -2.0]) / 21.0,
)
"""Local quadratic fits to 5 and to 7 equally spaced values (Savitzky and Golay 1964)."""

REACH_PX = 6.0
MAX_STRAY = 4.0
SLACK = 0.15
BEYOND = 3.0
"""How much less is known of s beyond the ends of a run."""


def interpolate_stripes(
    boundaries: Boundaries, codes: NDArray[np.int32], usable: Mask
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """s and its standard deviation, (L, P) each, NaN where there is none.

    Between two boundaries s is linear. In the half stripes at both ends of a run it goes on as in
    the whole stripe beside them.
    """
    s = np.full(codes.shape, np.nan, np.float32)
    sigma = s.copy()
    joined = boundaries.joined
    if not joined.any():
        return s, sigma
    stripes = _Segments.of(boundaries, joined)
    last = _last_boundary(boundaries, codes.shape)
    wanted = np.flatnonzero(usable & (last >= 0))
    stripes.fill(s, sigma, wanted, last.ravel()[wanted], codes, 1.0)
    for neighbour in (-1, 1):
        wanted = np.flatnonzero(usable & np.isnan(s))
        segment = last.ravel()[wanted] + neighbour
        within = (segment >= 0) & (segment < len(joined))
        wanted, segment = wanted[within], segment[within]
        here = boundaries.line[segment + (neighbour < 0)] == wanted // codes.shape[1]
        stripes.fill(s, sigma, wanted[here], segment[here], codes, BEYOND)
    return s, sigma


def _last_boundary(boundaries: Boundaries, shape: tuple[int, ...]) -> NDArray[np.int32]:
    """(L, P): which boundary was last crossed at or before each pixel, over all lines; or -1."""
    crossed = np.zeros(shape, np.int32)
    crossed[boundaries.line, boundaries.before + 1] = 1
    return np.cumsum(crossed.ravel(), dtype=np.int32).reshape(shape) - 1


@dataclass(frozen=True, eq=False)
class _Segments:
    """s = offset + slope * place on a scan line between boundaries j and j + 1; NaN if not joined.

    float64: an offset may be large where the slope is.
    """

    slope: Floats
    offset: Floats
    sigma: Floats

    @staticmethod
    def of(boundaries: Boundaries, joined: Mask) -> _Segments:
        position, sigma_px = smoothed(boundaries, joined)
        width = np.where(joined, np.diff(position), np.nan)
        width[width < MIN_STRIPE_PX] = np.nan
        slope = np.diff(boundaries.index) / width
        sigma = np.abs(slope) * np.sqrt((sigma_px[1:] ** 2 + sigma_px[:-1] ** 2) / 2)
        return _Segments(slope, boundaries.index[:-1] - slope * position[:-1], sigma)

    def fill(
        self,
        s: NDArray[np.float32],
        sigma: NDArray[np.float32],
        pixels: NDArray[np.intp],
        segment: NDArray[np.integer],
        codes: NDArray[np.int32],
        doubt: float,
    ) -> None:
        """Writes s and sigma at flat `pixels` from their segments, where the code agrees."""
        place = pixels % s.shape[1]
        segment = np.minimum(segment, len(self.slope) - 1)
        value = self.offset[segment] + self.slope[segment] * place
        agrees = np.abs(value - codes.ravel()[pixels] - 0.5) < 0.5 + SLACK
        s.ravel()[pixels[agrees]] = value[agrees]
        sigma.ravel()[pixels[agrees]] = doubt * self.sigma[segment[agrees]]


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
