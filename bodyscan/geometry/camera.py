"""The chapter's pinhole camera (Eq. 1) with two radial coefficients acting before A (Eq. 3-5)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Camera:
    """Intrinsics in pixels, (u, v) = (column, row), whole numbers at pixel centres.

    Camera frame: x right, y down, z forward, mm.
    """

    alpha: float
    beta: float
    gamma: float
    u0: float
    v0: float
    k1: float
    k2: float
    width: int
    height: int

    @property
    def matrix(self) -> Array:
        """A of Eq. 1, (3, 3)."""
        return np.array(
            [[self.alpha, self.gamma, self.u0], [0.0, self.beta, self.v0], [0.0, 0.0, 1.0]]
        )

    def project(self, points: Array) -> Array:
        """Points (..., 3) in the camera frame, z > 0 -> real image coordinates (..., 2), px."""
        normalized = points[..., :2] / points[..., 2:3]
        return self.pixels_from_normalized(self.distort(normalized))

    def rays(self, pixels: Array) -> Array:
        """Real image coordinates (..., 2) -> directions (..., 3) in the camera frame with z = 1."""
        normalized = self.undistort(self.normalized_from_pixels(pixels))
        return np.concatenate([normalized, np.ones_like(normalized[..., :1])], axis=-1)

    def pixel_rays(self) -> Array:
        """Rays through every pixel's centre, (height, width, 3)."""
        u, v = np.meshgrid(np.arange(self.width, dtype=float), np.arange(self.height, dtype=float))
        return self.rays(np.stack([u, v], axis=-1))

    def pixels_from_normalized(self, normalized: Array) -> Array:
        """Eq. 1 with A: normalized (..., 2) -> px (..., 2)."""
        x, y = normalized[..., 0], normalized[..., 1]
        u = self.alpha * x + self.gamma * y + self.u0
        return np.stack([u, self.beta * y + self.v0], axis=-1)

    def normalized_from_pixels(self, pixels: Array) -> Array:
        """Eq. 5 (and Eq. 11, 12 divided by z): px (..., 2) -> normalized (..., 2)."""
        y = (pixels[..., 1] - self.v0) / self.beta
        x = (pixels[..., 0] - self.u0 - self.gamma * y) / self.alpha
        return np.stack([x, y], axis=-1)

    def distort(self, normalized: Array) -> Array:
        """Ideal to real, normalized (..., 2).

        Eq. 3 and 4 scale (u - u0, v - v0); since A is linear this is the same as scaling (x, y).
        """
        r2 = np.sum(normalized**2, axis=-1, keepdims=True)
        return normalized * (1.0 + r2 * (self.k1 + r2 * self.k2))

    def undistort(self, normalized: Array) -> Array:
        """Real to ideal, normalized (..., 2), by Newton's method on the radius."""
        real = np.linalg.norm(normalized, axis=-1, keepdims=True)
        ideal = real.copy()
        for _ in range(8):
            r2 = ideal**2
            value = ideal * (1.0 + r2 * (self.k1 + r2 * self.k2)) - real
            slope = 1.0 + r2 * (3.0 * self.k1 + 5.0 * r2 * self.k2)
            ideal -= value / slope
        return normalized * np.divide(ideal, real, out=np.ones_like(real), where=real > 0)

    def without_skew(self, pixels: Array) -> Array:
        """Shear px (..., 2) by -gamma/beta, so that a camera without skew would have seen them."""
        sheared = pixels.copy()
        sheared[..., 0] -= self.gamma / self.beta * (pixels[..., 1] - self.v0)
        return sheared
