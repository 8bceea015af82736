"""The chapter's lens (Eq. 3-5): two radial coefficients."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from bodyscan.arrays import Array
from bodyscan.geometry.lenses.lens import NEWTON_STEPS, Lens, has_converged
from bodyscan.geometry.lenses.polynomials import radial_jacobian, squared_radius


@dataclass(frozen=True)
class Radial(Lens):
    """real = ideal (1 + k1 r^2 + k2 r^4), with r the ideal point's distance from the axis.

    Eq. 3 and 4 scale (u - u0, v - v0); since A is linear this is the same as scaling (x, y).
    """

    k1: float = 0.0
    k2: float = 0.0

    kind: ClassVar[str] = "radial"
    colmap_model: ClassVar[str | None] = "RADIAL"

    @property
    def prior_sigmas(self) -> Array:
        return np.array([0.5, 0.5])  # several times those of any lens on a scanner

    @property
    def difference_steps(self) -> Array:
        return np.array([1e-5, 1e-5])

    def distort(self, ideal: Array) -> Array:
        r2 = squared_radius(ideal)[..., None]
        return ideal * (1.0 + r2 * (self.k1 + r2 * self.k2))

    def by_coefficients(self, ideal: Array) -> Array:
        r2 = squared_radius(ideal)[..., None]
        return np.stack([ideal * r2, ideal * r2**2], axis=-1)

    def by_point(self, ideal: Array) -> Array:
        r2 = squared_radius(ideal)
        factor = 1.0 + r2 * (self.k1 + r2 * self.k2)
        return radial_jacobian(ideal, factor, self.k1 + 2.0 * r2 * self.k2)

    @property
    def fold_radius(self) -> float:
        """See `Lens.fold_radius`: the least r > 0 with 1 + 3 k1 r^2 + 5 k2 r^4 = 0."""
        discriminant = 9.0 * self.k1**2 - 20.0 * self.k2
        per_r2 = 0.5 * (np.sqrt(discriminant) - 3.0 * self.k1) if discriminant >= 0.0 else 0.0
        return float(1.0 / np.sqrt(per_r2)) if per_r2 > 0.0 else np.inf

    def undistort(self, real: Array) -> Array:
        """See `Lens.undistort`; Newton's method on the radius alone."""
        radius = np.linalg.norm(real, axis=-1, keepdims=True)
        ideal = radius.copy()
        with np.errstate(all="ignore"):
            for _ in range(NEWTON_STEPS):
                r2 = ideal**2
                value = ideal * (1.0 + r2 * (self.k1 + r2 * self.k2)) - radius
                step = value / (1.0 + r2 * (3.0 * self.k1 + 5.0 * r2 * self.k2))
                ideal -= step
                if has_converged(step):
                    break
            scale = np.divide(ideal, radius, out=np.ones_like(radius), where=radius > 0)
            return self.before_fold(real * scale, real)

    def opencv(self) -> Array:
        return np.array([self.k1, self.k2, 0.0, 0.0, 0.0])

    @classmethod
    def from_opencv(cls, coefficients: Array) -> Self | None:
        k1, k2, *others = (float(value) for value in coefficients)
        return None if any(others) else cls(k1, k2)
