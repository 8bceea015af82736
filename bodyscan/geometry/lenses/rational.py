"""OpenCV's rational lens: Brown's, with its radial factor divided by a second polynomial."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from bodyscan.arrays import Array
from bodyscan.geometry.lenses.brown import Brown
from bodyscan.geometry.lenses.polynomials import decentring, displace_by_decentring, squared_radius


@dataclass(frozen=True)
class Rational(Brown):
    """Brown's lens with the radial factor

        (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6),

    which, unlike a polynomial, can level out at large radii, as wide lenses do.

    Source: Claus and Fitzgibbon, A Rational Function Lens Distortion Model, CVPR 2005; OpenCV's
    CALIB_RATIONAL_MODEL.
    """

    k4: float = 0.0
    k5: float = 0.0
    k6: float = 0.0

    kind: ClassVar[str] = "rational"

    @property
    def prior_sigmas(self) -> Array:
        return np.append(super().prior_sigmas, [0.5, 0.5, 0.2])

    @property
    def difference_steps(self) -> Array:
        return np.append(super().difference_steps, [1e-5, 1e-5, 1e-4])

    def distort(self, ideal: Array) -> Array:
        r2 = squared_radius(ideal)[..., None]
        radial = ideal * self._above(r2) / self._below(r2)
        return radial + displace_by_decentring(ideal, self.p1, self.p2)

    def by_coefficients(self, ideal: Array) -> Array:
        r2 = squared_radius(ideal)[..., None, None]
        below = self._below(r2)
        point = ideal[..., None] / below
        by_divisor = -point * self._above(r2) / below
        powers = np.concatenate([r2, r2**2, r2**3], axis=-1)
        parts = [point * powers[..., :2], decentring(ideal), point * powers[..., 2:]]
        return np.concatenate([*parts, by_divisor * powers], axis=-1)

    def _below(self, r2: Array) -> Array:
        """The divisor at squared radii."""
        return 1.0 + r2 * (self.k4 + r2 * (self.k5 + r2 * self.k6))

    def _factor(self, r2: Array) -> tuple[Array, Array]:
        above, above_slope = super()._factor(r2)
        below = self._below(r2)
        below_slope = self.k4 + r2 * (2.0 * self.k5 + r2 * 3.0 * self.k6)
        factor = above / below
        return factor, (above_slope - factor * below_slope) / below
