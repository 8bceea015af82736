"""Combine the points measured by stripes of two directions, weighted by their sigmas.

A pixel's ray meets a sheet of each direction. Both depths lie on the same ray, so they differ only
by errors of decoding and calibration: a check that needs no board.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodyscan.arrays import Floats, Mask
from bodyscan.geometry.robust import SIGMAS_PER_MEDIAN

MOST_OFF = 5.0
"""Sigmas: noise alone does not reach it; a wrong code does, or a pixel that saw two surfaces."""
BELIEVED = 2.0
"""Sigmas by which the directions may usually differ. Beyond, sigmas lack most of the error (an
imported calibration's lack all of its own) and cannot weight the directions."""
FEWEST = 100
SOME_APART = 2e-3
"""Of the projector's picture: calibrations reproject to half a pixel or one of some 1000, a
thousandth; twice that is more than their noise."""
MOST_APART = 2e-2
"""Of the projector's picture, about half a degree: no calibration is off by that, while a wrong
pose, sign or number of stripes is off by more."""


@dataclass(frozen=True)
class Agreement:
    """How well the two directions agree.

    pixels: number of pixels that have both depths.
    apart_mm: robust sigma of their difference along the rays, mm.
    apart_sigmas: the same in units of the sigmas of both depths.
    dropped: pixels beyond MOST_OFF times that, or times their sigmas if larger, which get no point.
    apart_stripes: the same in stripes of the direction with less accurate depth.
    stripes: number of stripes of that direction.
    """

    pixels: int
    apart_mm: float
    apart_sigmas: float
    dropped: int
    apart_stripes: float = np.nan
    stripes: int = 0

    @property
    def moderate(self) -> bool:
        """Whether the calibration, not noise, is off by more than is usual."""
        return self._beyond(SOME_APART)

    @property
    def impossible(self) -> bool:
        """Whether no right calibration is off by so much."""
        return self._beyond(MOST_APART)

    @property
    def words(self) -> str:
        return (
            f"{self.apart_stripes:.1f} of {self.stripes} stripes of the direction that tells depth "
            f"less ({self.apart_sigmas:.1f} of their sigmas)"
        )

    def _beyond(self, share: float) -> bool:
        return self.apart_sigmas > BELIEVED and self.apart_stripes > share * self.stripes

    def __str__(self) -> str:
        return (
            f"stripes of both directions agree to {self.words} at {self.pixels} pixels; "
            f"{self.dropped} that do not were left out"
        )


def combine(
    points: Floats, sigma_mm: Floats, crossing: Floats, crossing_mm: Floats, *, alone: Mask
) -> tuple[Floats, Floats, Agreement | None]:
    """Points (H, W, 3) and sigmas (H, W) along their rays, from those of both directions.

    alone: where the crossing stripes may give a point by themselves, (H, W).

    NaN where there are none; the agreement is None if too few pixels have both. Depths are weighted
    by their sigmas. If the sigmas are too small (an imported calibration may have none), all pixels
    disagree alike: then only those far beyond the others are dropped, and the better direction
    alone gives the depth, the other being a check.
    """
    points, sigma_mm = points.copy(), sigma_mm.copy()
    both = np.isfinite(sigma_mm) & np.isfinite(crossing_mm)
    alone = alone & ~np.isfinite(sigma_mm) & np.isfinite(crossing_mm)
    points[alone], sigma_mm[alone] = crossing[alone], crossing_mm[alone]
    pixels = int(np.count_nonzero(both))
    if pixels < FEWEST:
        return points, sigma_mm, None
    one, other = points[both], crossing[both]
    variance, variance_too = sigma_mm[both] ** 2, crossing_mm[both] ** 2
    along = np.linalg.norm(one, axis=1) - np.linalg.norm(other, axis=1)
    off = along / np.sqrt(variance + variance_too)
    sigmas = SIGMAS_PER_MEDIAN * float(np.median(np.abs(off)))
    wrong = np.abs(off) > MOST_OFF * max(sigmas, 1.0)
    share = variance / (variance + variance_too)  # of the other direction: weights are 1 / variance
    if sigmas > BELIEVED:
        share = np.full_like(share, float(np.median(share) > 0.5))
    points[both] = one + share[:, None] * (other - one)
    merged = np.sqrt((1.0 - share) ** 2 * variance + share**2 * variance_too)
    sigma_mm[both] = np.where(wrong, np.float32(np.nan), merged)
    apart = SIGMAS_PER_MEDIAN * float(np.median(np.abs(along)))
    return points, sigma_mm, Agreement(pixels, apart, sigmas, int(np.count_nonzero(wrong)))
