"""Points that stripes of two directions measure: of both, as well as each is known, where they agree.

A pixel's ray meets a sheet of each family. Both depths are of the same ray, so that they differ by
what decoding and calibration are off, and by nothing else: a check that needs no board.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodyscan.arrays import Floats, Mask
from bodyscan.geometry.robust import SIGMAS_PER_MEDIAN

MOST_OFF = 5.0
"""Sigmas: noise alone does not get there; a wrong code does, or a pixel that saw two surfaces."""
BELIEVED = 2.0
"""Sigmas that the ways may commonly be apart: beyond, sigmas lack most of what is wrong (those of a
calibration made elsewhere lack all of its own error), and cannot say what each way is worth."""
FEWEST = 100
SOME_APART = 2e-3
"""Of the projector's picture: calibrations reproject to half a pixel or one of some 1000, a
thousandth; twice that is no noise of theirs."""
MOST_APART = 2e-2
"""Of the projector's picture, about half a degree: no calibration is off by that, a wrong pose, sign
or number of stripes is by more."""


@dataclass(frozen=True)
class Agreement:
    """How far the two ways were apart along the rays of `pixels` that have both: robust sigma, mm,
    and the same in the sigmas that both depths claim.  dropped: pixels beyond MOST_OFF of those, or
    of the claimed ones if these are larger, which have no point.  apart_stripes: the same in the
    stripes, of so many, of the way that tells depth less."""

    pixels: int
    apart_mm: float
    apart_sigmas: float
    dropped: int
    apart_stripes: float = np.nan
    stripes: int = 0

    @property
    def moderate(self) -> bool:
        """Whether a calibration, not noise, is off by more than calibrations are."""
        return self._beyond(SOME_APART)

    @property
    def impossible(self) -> bool:
        """Whether no calibration that is right is off by so much."""
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
    """Points (H, W, 3) with sigma (H, W) along their rays from those of each way, NaN where none;
    None where too few pixels have both.

    alone: (H, W), where the crossing stripes may tell a point by themselves. Depths are weighted
    by what their sigmas say. Sigmas that claim too little (calibrations of other programs have none)
    make every pixel disagree alike: what is dropped is far beyond what most do, and the better way
    alone tells the depth, the other being a check.
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
    share = variance / (variance + variance_too)  # of the other: weights are 1 / variance
    if sigmas > BELIEVED:
        share = np.full_like(share, float(np.median(share) > 0.5))
    points[both] = one + share[:, None] * (other - one)
    merged = np.sqrt((1.0 - share) ** 2 * variance + share**2 * variance_too)
    sigma_mm[both] = np.where(wrong, np.float32(np.nan), merged)
    apart = SIGMAS_PER_MEDIAN * float(np.median(np.abs(along)))
    return points, sigma_mm, Agreement(pixels, apart, sigmas, int(np.count_nonzero(wrong)))
