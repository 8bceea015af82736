"""What a camera asks of its lens: real from ideal image points and back, before the matrix A.

Points are normalised: x = X/Z and y = Y/Z of the camera frame.  Ideal ones are where a pinhole would
show them, real ones where the lens does.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, fields, replace
from typing import ClassVar, Self

import numpy as np

from bodyscan.arrays import Array
from bodyscan.errors import BadInput

NEWTON_STEPS = 8  # to rounding, wherever the lens does not fold


@dataclass(frozen=True)
class Lens(ABC):
    """A lens is a frozen value; its fields are its coefficients, all 0 where it bends nothing.

    kind: its name in files.  colmap_model: COLMAP's model with one focal length and these very
    coefficients in this order, if there is one.
    """

    kind: ClassVar[str]
    colmap_model: ClassVar[str | None] = None

    @property
    def names(self) -> tuple[str, ...]:
        """Of the K coefficients, in files as well."""
        return tuple(field.name for field in fields(self))

    @property
    def coefficients(self) -> Array:
        """(K,)."""
        return np.array([getattr(self, name) for name in self.names], np.float64)

    def with_coefficients(self, values: Array) -> Self:
        """The same kind of lens with other coefficients (K,)."""
        return replace(self, **{name: float(v) for name, v in zip(self.names, values, strict=True)})

    @property
    @abstractmethod
    def prior_sigmas(self) -> Array:
        """(K,) standard deviations of the coefficients before any image was seen."""

    @property
    @abstractmethod
    def difference_steps(self) -> Array:
        """(K,) for derivatives by differences: about 1e-3 px at the rim of a scanner's image."""

    @abstractmethod
    def distort(self, ideal: Array) -> Array:
        """Ideal to real points, (..., 2)."""

    @abstractmethod
    def by_coefficients(self, ideal: Array) -> Array:
        """Derivatives (..., 2, K) of real points by the coefficients, at ideal points (..., 2)."""

    @abstractmethod
    def by_point(self, ideal: Array) -> Array:
        """Derivatives (..., 2, 2) of real points by the ideal ones (..., 2)."""

    def undistort(self, real: Array) -> Array:
        """Real to ideal points, (..., 2), by Newton's method from the real ones.

        Good to rounding wherever `distort` is one to one between the axis and the point.  Where it
        folds back no ideal point need belong to a real one: what comes back there means nothing.
        """
        ideal = np.array(real, np.float64)
        for _ in range(NEWTON_STEPS):
            (a, b), (c, d) = np.moveaxis(self.by_point(ideal), (-2, -1), (0, 1))
            x, y = np.moveaxis(self.distort(ideal) - real, -1, 0)
            ideal -= np.stack([d * x - b * y, a * y - c * x], axis=-1) / (a * d - b * c)[..., None]
        return ideal

    def opencv(self) -> Array:
        """(5,) or more of OpenCV's distortion coefficients k1, k2, p1, p2, k3, ...

        Raises BadInput for a lens that OpenCV does not have.
        """
        raise BadInput(
            f"OpenCV and COLMAP have no lens like {self.kind!r}",
            remedy="calibrate with another lens for programs that go by theirs",
        )

    @classmethod
    def from_opencv(cls, coefficients: Array) -> Self | None:
        """The lens with OpenCV's coefficients (5,) or more; None if it has not all of them."""
        return None
