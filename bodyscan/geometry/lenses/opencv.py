"""OpenCV's lens: a factor that changes with the radius, and decentring.

The chapter's lens (Eq. 3-5) and Brown's are its first coefficients.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from bodyscan.arrays import Array
from bodyscan.geometry.lenses.lens import Lens

PRIOR_SIGMAS = (0.5, 0.5, 5e-4, 5e-4, 0.2, 0.5, 0.5, 0.2)
"""Of all eight coefficients: for k several times those of any lens on a scanner. Real lenses have p1
and p2 of 1e-4 to 1e-3; a few boards hardly separate them from the principal point, and with a prior
ten times as wide Brown's lens did worse on held-out boards than k1 and k2 alone."""


@dataclass(frozen=True)
class OpenCVLens(Lens):
    """A lens with the first few of k1, k2, p1, p2, k3, k4, k5, k6, the others being 0:

        real = ideal (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6)
               + (2 p1 x y + p2 (r^2 + 2 x^2), p1 (r^2 + 2 y^2) + 2 p2 x y).

    The chapter scales (u - u0, v - v0); since A is linear this is the same as scaling (x, y).
    """

    @property
    def prior_sigmas(self) -> Array:
        return np.array(PRIOR_SIGMAS[: len(self.names)])

    def distort(self, ideal: Array) -> Array:
        x, y = ideal[..., 0], ideal[..., 1]
        r2, p1, p2 = x * x + y * y, *self._eight[2:4]
        factor, _, _ = self._radial(r2)
        real = np.empty(ideal.shape)
        real[..., 0] = x * factor + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
        real[..., 1] = y * factor + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
        return real

    def by_coefficients(self, ideal: Array) -> Array:
        x, y = ideal[..., 0], ideal[..., 1]
        r2 = x * x + y * y
        factor, _, share = self._radial(r2)
        powers = np.stack([r2, r2**2, r2**3], axis=-1)[..., None, :] * share[..., None, None]
        above = ideal[..., None] * powers
        decentring = np.stack([2.0 * x * y, r2 + 2.0 * x * x, r2 + 2.0 * y * y, 2.0 * x * y], -1)
        decentring = decentring.reshape(*x.shape, 2, 2)
        below = -above * factor[..., None, None]
        parts = [above[..., :2], decentring, above[..., 2:], below]
        return np.concatenate(parts, axis=-1)[..., : len(self.names)]

    def by_point(self, ideal: Array) -> Array:
        x, y = ideal[..., 0], ideal[..., 1]
        p1, p2 = self._eight[2:4]
        factor, slope, _ = self._radial(x * x + y * y)
        derivatives = np.empty((*x.shape, 2, 2))
        derivatives[..., 0, 0] = factor + 2.0 * (slope * x * x + p1 * y + 3.0 * p2 * x)
        derivatives[..., 1, 1] = factor + 2.0 * (slope * y * y + 3.0 * p1 * y + p2 * x)
        derivatives[..., 0, 1] = derivatives[..., 1, 0] = 2.0 * (slope * x * y + p1 * x + p2 * y)
        return derivatives

    def opencv(self) -> Array:
        return np.array(self._eight[: max(len(self.names), 5)])

    @classmethod
    def from_opencv(cls, coefficients: Array) -> Self | None:
        count = len(cls().names)
        given = np.append(coefficients, np.zeros(count))
        return None if np.any(given[count:]) else cls().with_coefficients(given[:count])

    @property
    def _eight(self) -> tuple[float, ...]:
        values = tuple(getattr(self, name) for name in self.names)
        return values + (0.0,) * (len(PRIOR_SIGMAS) - len(values))

    def _radial(self, r2: Array) -> tuple[Array, Array, Array]:
        """The radial factor at squared radii, its derivative by them, and 1 / (1 + k4 r^2 + ...)."""
        k1, k2, _, _, k3, k4, k5, k6 = self._eight
        share = 1.0 / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)))
        factor = (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))) * share
        slope = k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3)
        slope = (slope - factor * (k4 + r2 * (2.0 * k5 + r2 * 3.0 * k6))) * share
        return factor, slope, share


@dataclass(frozen=True)
class Radial(OpenCVLens):
    """The chapter's lens (Eq. 3-5): two radial coefficients."""

    k1: float = 0.0
    k2: float = 0.0

    kind: ClassVar[str] = "radial"


@dataclass(frozen=True)
class Brown(Radial):
    """Three radial coefficients and two of decentring.

    Source: D. C. Brown, Decentering Distortion of Lenses, 1966.
    """

    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0

    kind: ClassVar[str] = "brown"


@dataclass(frozen=True)
class Rational(Brown):
    """Brown's lens divided by a polynomial: it can level out at large radii, as wide lenses do.

    Source: Claus and Fitzgibbon, A Rational Function Lens Distortion Model, CVPR 2005.
    """

    k4: float = 0.0
    k5: float = 0.0
    k6: float = 0.0

    kind: ClassVar[str] = "rational"
