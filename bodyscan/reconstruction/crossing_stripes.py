"""Combine the depths from stripes of two directions, weighted by their variances.

A pixel's ray intersects a light sheet of each direction. Both depths lie on the same ray, so they
differ only by errors of decoding and calibration: a check that needs no board.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodyscan.arrays import Floats, Mask
from bodyscan.geometry.robust import SIGMAS_PER_MEDIAN

MAX_RATIO = 2.0
"""Sigmas by which the directions may typically differ. Beyond, sigmas lack most of the error (an
imported calibration's lack all of its own) and cannot weight the directions."""


@dataclass(frozen=True)
class Agreement:
    """How well the two directions agree.

    pixels: number of pixels that have both depths.
    offset_mm: robust sigma of their difference along the rays, mm.
    offset_sigmas: the same in units of the sigmas of both depths.
    dropped: pixels that disagree and get no point.
    offset_stripes: the same in stripes of the less depth-sensitive direction.
    stripes: number of stripes of that direction.
    """

    pixels: int
    offset_mm: float
    offset_sigmas: float
    dropped: int
    offset_stripes: float = np.nan
    stripes: int = 0

    @property
    def moderate(self) -> bool:
        """Whether the calibration, not noise, is off by more than usual.

        By 0.002 of the projector's image: calibrations reproject to half a pixel or one of some 1000.
        """
        return self._exceeds(2e-3)

    @property
    def impossible(self) -> bool:
        """Whether no right calibration is off by so much.

        By 0.02 of the projector's image, half a degree: a wrong pose, sign or number of stripes.
        """
        return self._exceeds(2e-2)

    @property
    def description(self) -> str:
        return (
            f"{self.offset_stripes:.1f} of {self.stripes} stripes of the less depth-sensitive "
            f"direction ({self.offset_sigmas:.1f} sigmas)"
        )

    def _exceeds(self, share: float) -> bool:
        return self.offset_sigmas > MAX_RATIO and self.offset_stripes > share * self.stripes

    def __str__(self) -> str:
        return (
            f"stripes of both directions agree to {self.description} at {self.pixels} pixels; "
            f"{self.dropped} that disagree were dropped"
        )


def combine_directions(
    points: Floats, sigma_mm: Floats, crossing: Floats, crossing_mm: Floats, *, alone: Mask
) -> tuple[Floats, Floats, Agreement | None]:
    """Combine points (H, W, 3) and sigmas (H, W) along their rays from both directions.

    alone: where the crossing stripes may give a point by themselves, (H, W).

    NaN where there are none; the agreement is None if fewer than 100 pixels have both. Depths are
    weighted by their variances. If the sigmas are too small (an imported calibration may have none),
    all pixels disagree equally: then only those far beyond the others are dropped, and the better
    direction alone gives the depth, the other being a check.
    """
    points, sigma_mm = points.copy(), sigma_mm.copy()
    both = np.isfinite(sigma_mm) & np.isfinite(crossing_mm)
    alone = alone & ~np.isfinite(sigma_mm) & np.isfinite(crossing_mm)
    points[alone], sigma_mm[alone] = crossing[alone], crossing_mm[alone]
    pixels = int(np.count_nonzero(both))
    if pixels < 100:
        return points, sigma_mm, None
    one, other = points[both], crossing[both]
    variance, crossing_variance = sigma_mm[both] ** 2, crossing_mm[both] ** 2
    difference = np.linalg.norm(one, axis=1) - np.linalg.norm(other, axis=1)
    normalized = difference / np.sqrt(variance + crossing_variance)
    sigmas = SIGMAS_PER_MEDIAN * float(np.median(np.abs(normalized)))
    # Noise alone does not reach five sigmas; a wrong code does, or a pixel that saw two surfaces.
    wrong = np.abs(normalized) > 5.0 * max(sigmas, 1.0)
    share = variance / (variance + crossing_variance)  # of the crossing direction
    if sigmas > MAX_RATIO:
        share = np.full_like(share, float(np.median(share) > 0.5))
    points[both] = one + share[:, None] * (other - one)
    merged = np.sqrt((1.0 - share) ** 2 * variance + share**2 * crossing_variance)
    sigma_mm[both] = np.where(wrong, np.float32(np.nan), merged)
    offset = SIGMAS_PER_MEDIAN * float(np.median(np.abs(difference)))
    return points, sigma_mm, Agreement(pixels, offset, sigmas, int(np.count_nonzero(wrong)))
