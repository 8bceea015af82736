"""OpenCV's rational lens: Brown's, its radial factor divided by another polynomial of the radius."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from bodyscan.arrays import Array
from bodyscan.geometry.lenses.lens import Lens
from bodyscan.geometry.lenses.polynomials import (
    DECENTRED,
    decentring,
    decentring_by_point,
    scaled_by_point,
    squared_radius,
)


@dataclass(frozen=True)
class Rational(Lens):
    """As `Brown`, but its radial factor is
    (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6): it can level out where a
    polynomial runs away, as wide lenses do.

    Source: Claus and Fitzgibbon, A Rational Function Lens Distortion Model, CVPR 2005; OpenCV's
    CALIB_RATIONAL_MODEL.
    """

    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    k5: float = 0.0
    k6: float = 0.0

    kind: ClassVar[str] = "rational"

    @property
    def prior_sigmas(self) -> Array:
        return np.array([0.5, 0.5, DECENTRED, DECENTRED, 0.2, 0.5, 0.5, 0.2])

    @property
    def difference_steps(self) -> Array:
        return np.array([*[1e-5] * 4, 1e-4, 1e-5, 1e-5, 1e-4])

    def distort(self, ideal: Array) -> Array:
        above, below = self._parts(squared_radius(ideal)[..., None])
        return ideal * above / below + decentring(ideal) @ np.array([self.p1, self.p2])

    def by_coefficients(self, ideal: Array) -> Array:
        r2 = squared_radius(ideal)[..., None, None]
        above, below = self._parts(r2)
        point = ideal[..., None] / below
        turned = -point * above / below
        powers = np.concatenate([r2, r2**2, r2**3], axis=-1)
        parts = [point * powers[..., :2], decentring(ideal), point * powers[..., 2:]]
        return np.concatenate([*parts, turned * powers], axis=-1)

    def by_point(self, ideal: Array) -> Array:
        r2 = squared_radius(ideal)
        above, below = self._parts(r2)
        above_slope = self.k1 + r2 * (2.0 * self.k2 + r2 * 3.0 * self.k3)
        below_slope = self.k4 + r2 * (2.0 * self.k5 + r2 * 3.0 * self.k6)
        factor = above / below
        slope = (above_slope - factor * below_slope) / below
        return scaled_by_point(ideal, factor, slope) + decentring_by_point(ideal, self.p1, self.p2)

    def opencv(self) -> Array:
        return self.coefficients

    @classmethod
    def from_opencv(cls, coefficients: Array) -> Self | None:
        given = np.append(coefficients, np.zeros(8))
        return None if np.any(given[8:]) else cls(*given[:8].tolist())

    def _parts(self, r2: Array) -> tuple[Array, Array]:
        above = 1.0 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        return above, 1.0 + r2 * (self.k4 + r2 * (self.k5 + r2 * self.k6))
