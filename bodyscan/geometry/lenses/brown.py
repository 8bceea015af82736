"""Brown's lens as OpenCV defines it: three radial coefficients and two of decentring."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import ClassVar, Self

import numpy as np

from bodyscan.arrays import Array
from bodyscan.geometry.lenses.lens import Lens
from bodyscan.geometry.lenses.polynomials import (
    DECENTRED,
    decentring,
    decentring_jacobian,
    displace_by_decentring,
    radial_jacobian,
    squared_radius,
)


@dataclass(frozen=True)
class Brown(Lens):
    """Brown's lens:

        real = ideal (1 + k1 r^2 + k2 r^4 + k3 r^6)
               + (2 p1 x y + p2 (r^2 + 2 x^2), p1 (r^2 + 2 y^2) + 2 p2 x y).

    Source: D. C. Brown, Decentering Distortion of Lenses, 1966; p1 and p2 numbered as in OpenCV.
    """

    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0

    kind: ClassVar[str] = "brown"

    @property
    def prior_sigmas(self) -> Array:
        return np.array([0.5, 0.5, DECENTRED, DECENTRED, 0.2])

    @property
    def difference_steps(self) -> Array:
        return np.array([*[1e-5] * 4, 1e-4])

    def distort(self, ideal: Array) -> Array:
        factor = self._above(squared_radius(ideal)[..., None])
        return ideal * factor + displace_by_decentring(ideal, self.p1, self.p2)

    def by_coefficients(self, ideal: Array) -> Array:
        r2 = squared_radius(ideal)[..., None, None]
        point = ideal[..., None]
        parts = [point * r2, point * r2**2, decentring(ideal), point * r2**3]
        return np.concatenate(parts, axis=-1)

    def by_point(self, ideal: Array) -> Array:
        factor, slope = self._factor(squared_radius(ideal))
        return radial_jacobian(ideal, factor, slope) + decentring_jacobian(ideal, self.p1, self.p2)

    def opencv(self) -> Array:
        return self.coefficients

    @classmethod
    def from_opencv(cls, coefficients: Array) -> Self | None:
        count = len(fields(cls))
        given = np.append(coefficients, np.zeros(count))
        return None if np.any(given[count:]) else cls(*given[:count].tolist())

    def _above(self, r2: Array) -> Array:
        """The radial polynomial at squared radii."""
        return 1.0 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))

    def _factor(self, r2: Array) -> tuple[Array, Array]:
        """The radial factor at squared radii, and its derivative by them."""
        return self._above(r2), self.k1 + r2 * (2.0 * self.k2 + r2 * 3.0 * self.k3)
