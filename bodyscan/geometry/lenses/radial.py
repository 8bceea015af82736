"""The chapter's lens (Eq. 3-5): two radial coefficients."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from bodyscan.arrays import Array
from bodyscan.geometry.lenses.lens import NEWTON_STEPS, Lens


@dataclass(frozen=True)
class Radial(Lens):
    """real = ideal (1 + k1 r^2 + k2 r^4), r the ideal point's distance from the axis.

    Eq. 3 and 4 scale (u - u0, v - v0); since A is linear this is the same as scaling (x, y).
    """

    k1: float = 0.0
    k2: float = 0.0

    kind: ClassVar[str] = "radial"
    colmap_model: ClassVar[str | None] = "RADIAL"

    @property
    def prior_sigmas(self) -> Array:
        return np.array([0.5, 0.5])  # several times those of any lens that a scanner has

    @property
    def difference_steps(self) -> Array:
        return np.array([1e-5, 1e-5])

    def distort(self, ideal: Array) -> Array:
        r2 = np.sum(ideal**2, axis=-1, keepdims=True)
        return ideal * (1.0 + r2 * (self.k1 + r2 * self.k2))

    def by_coefficients(self, ideal: Array) -> Array:
        r2 = np.sum(ideal**2, axis=-1, keepdims=True)
        return np.stack([ideal * r2, ideal * r2**2], axis=-1)

    def by_point(self, ideal: Array) -> Array:
        x, y = ideal[..., 0], ideal[..., 1]
        r2 = x * x + y * y
        factor = 1.0 + r2 * (self.k1 + r2 * self.k2)
        slope = 2.0 * (self.k1 + 2.0 * r2 * self.k2)
        derivatives = np.empty((*r2.shape, 2, 2))
        derivatives[..., 0, 0] = factor + slope * x * x
        derivatives[..., 1, 1] = factor + slope * y * y
        derivatives[..., 0, 1] = derivatives[..., 1, 0] = slope * x * y
        return derivatives

    def undistort(self, real: Array) -> Array:
        """As `Lens.undistort`, by Newton's method on the radius alone."""
        radius = np.linalg.norm(real, axis=-1, keepdims=True)
        ideal = radius.copy()
        for _ in range(NEWTON_STEPS):
            r2 = ideal**2
            value = ideal * (1.0 + r2 * (self.k1 + r2 * self.k2)) - radius
            slope = 1.0 + r2 * (3.0 * self.k1 + 5.0 * r2 * self.k2)
            ideal -= value / slope
        return real * np.divide(ideal, radius, out=np.ones_like(radius), where=radius > 0)

    def opencv(self) -> Array:
        return np.array([self.k1, self.k2, 0.0, 0.0, 0.0])

    @classmethod
    def from_opencv(cls, coefficients: Array) -> Self | None:
        k1, k2, *others = (float(value) for value in coefficients)
        return None if any(others) else cls(k1, k2)
