"""What a camera needs from its lens: ideal to real image points and back, before the matrix A.

Points are normalised: x = X/Z and y = Y/Z in the camera frame. Ideal points are where a pinhole
would image them, real points where the lens does.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import ClassVar, Self

import numpy as np

from bodyscan.arrays import Array
from bodyscan.errors import BadInput

TOLERANCE, NOT_FOUND = 1e-14, 1e-9
"""A millionth of a pixel is about 1e-9."""


@dataclass(frozen=True)
class Lens(ABC):
    """A frozen value whose fields are its coefficients, all 0 for a lens that bends nothing."""

    kind: ClassVar[str]  # its name in files

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the K coefficients, as in files."""
        return self.__match_args__  # the fields' names, in a twentieth of the time

    @property
    def coefficients(self) -> Array:
        """Coefficients (K,) in the order of `names`."""
        return np.array([getattr(self, name) for name in self.names], np.float64)

    def with_coefficients(self, values: Array) -> Self:
        """The same kind of lens with other coefficients (K,)."""
        return replace(self, **{name: float(v) for name, v in zip(self.names, values, strict=True)})

    @property
    @abstractmethod
    def prior_sigmas(self) -> Array:
        """Standard deviations (K,) of the coefficients before any image is seen."""

    @abstractmethod
    def distort(self, ideal: Array) -> Array:
        """Real points (..., 2) of ideal ones (..., 2)."""

    @abstractmethod
    def by_coefficients(self, ideal: Array) -> Array:
        """Jacobian (..., 2, K) of distorted points by the coefficients, at ideal points (..., 2)."""

    @abstractmethod
    def by_point(self, ideal: Array) -> Array:
        """Jacobian (..., 2, 2) of distorted points by the ideal ones (..., 2)."""

    def fit_to(self, other: Lens, ideal: Array) -> Self:
        """Fit this kind of lens, starting here, to what `other` does to the points (N, 2)."""
        lens, wanted = self, other.distort(ideal)
        for _ in range(3):
            by_coefficient = lens.by_coefficients(ideal).reshape(-1, len(lens.names))
            missing = (wanted - lens.distort(ideal)).ravel()
            # A weak prior on what the points leave undetermined: one sigma costs 0.01 px.
            prior = np.diag(1e-5 / lens.prior_sigmas)
            rows = np.concatenate([by_coefficient, prior])
            right = np.concatenate([missing, -prior @ lens.coefficients])
            step = np.linalg.lstsq(rows, right, rcond=None)[0]
            lens = lens.with_coefficients(lens.coefficients + step)
        return lens

    @property
    def fold_radius(self) -> float:
        """Radius around the axis, in ideal points, within which the lens is one to one: where it
        first folds back in any direction; infinite if it never does."""
        return _fold_radius(self)

    def undistort(self, real: Array) -> Array:
        """Ideal points (..., 2) of real ones (..., 2), by Newton's method from the real points.

        Accurate to rounding within `fold_radius`; NaN where no ideal point within it maps there.
        """
        real = np.asarray(real, float)
        with np.errstate(all="ignore"):
            ideal = _at_most(real, 0.9 * self.fold_radius)
            for _ in range(20):  # 5 or 6 reach rounding, more near to where a lens folds
                (a, b), (c, d) = np.moveaxis(self.by_point(ideal), (-2, -1), (0, 1))
                residual = self.distort(ideal) - real
                x, y, scale = residual[..., 0], residual[..., 1], a * d - b * c
                step = np.empty_like(ideal)
                step[..., 0], step[..., 1] = (d * x - b * y) / scale, (a * y - c * x) / scale
                ideal = _at_most(ideal - step, 0.5 * (self.fold_radius + _radius(ideal)))
                # Diverged steps do not count.
                if np.max(np.abs(step), initial=0.0, where=np.isfinite(step)) < TOLERANCE:
                    break
            reached = _radius(self.distort(ideal) - real) < NOT_FOUND
            reached &= _radius(ideal) < self.fold_radius
            return np.where(reached[..., None], ideal, np.nan)

    def opencv(self) -> Array:
        """OpenCV's distortion coefficients k1, k2, p1, p2, k3, ... (5,) or more.

        Raises BadInput for a lens that OpenCV does not have.
        """
        remedy = "calibrate with another lens for programs that go by theirs"
        raise BadInput(f"OpenCV and COLMAP have no lens like {self.kind!r}", remedy=remedy)

    @classmethod
    def from_opencv(cls, coefficients: Array) -> Self | None:
        """The lens with OpenCV's coefficients (5,) or more; None if it lacks one of them."""
        return None


def _radius(points: Array) -> Array:
    """Distances (...) of points (..., 2) from the axis."""
    x, y = points[..., 0], points[..., 1]
    return np.asarray(np.sqrt(x * x + y * y), float)


def _at_most(points: Array, radius: Array | float) -> Array:
    """Points (..., 2), with those farther than `radius` (...) from the axis moved in to it."""
    radii = _radius(points)
    beyond = radii > radius
    if not beyond.any():
        return points
    return points * np.where(beyond, radius / radii, 1.0)[..., None]


@lru_cache(256)
def _fold_radius(lens: Lens) -> float:
    # Up to 87 degrees from its axis (radius 20), in 16 directions.
    turns = 2.0 * np.pi * np.arange(16) / 16
    around = np.stack([np.cos(turns), np.sin(turns)], axis=-1)
    radii = np.append(0.0, np.geomspace(0.02, 20.0, 1000))
    with np.errstate(all="ignore"):
        by_point = lens.by_point(radii[:, None, None] * around)
        (a, b), (c, d) = np.moveaxis(by_point, (-2, -1), (0, 1))
        folded = ~np.all((a * d - b * c > 0.0) & (a + d > 0.0), axis=1)
    return float(radii[max(int(np.argmax(folded)) - 1, 0)]) if folded.any() else np.inf
