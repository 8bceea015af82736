"""The true camera: a pinhole with skew behind a radially distorting lens (Eq. 1, 3-5).

Written for the simulator alone; it shares nothing with `bodyscan.geometry.camera`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodyscan.arrays import Array, Floats

_TABLE = 1 << 15


@dataclass(frozen=True)
class TrueCamera:
    """Intrinsics in px, (u, v) = (column, row), whole numbers at pixel centres; camera frame mm."""

    alpha: float
    beta: float
    gamma: float
    u0: float
    v0: float
    k1: float
    k2: float
    width: int
    height: int

    def image(self, points: Array) -> Array:
        """Points (..., 3) in front of the camera -> where the lens images them, (..., 2) px.

        Eq. 3 and 4 as they stand: the ideal point is pushed away from [u0, v0].
        """
        x, y = points[..., 0] / points[..., 2], points[..., 1] / points[..., 2]
        u = self.alpha * x + self.gamma * y + self.u0
        v = self.beta * y + self.v0
        square = x**2 + y**2
        push = self.k1 * square + self.k2 * square**2
        return np.stack([u + (u - self.u0) * push, v + (v - self.v0) * push], axis=-1)

    def directions(self, pixels: Array) -> Array:
        """px (..., 2) -> ray directions (..., 3) in the camera frame, z = 1.

        The lens is inverted by a dense table of real radius against ideal radius (accurate to
        about 1e-9 of the focal length).
        """
        y = (pixels[..., 1] - self.v0) / self.beta
        x = (pixels[..., 0] - self.u0 - self.gamma * y) / self.alpha
        real = np.hypot(x, y)
        ideal = np.linspace(0.0, 1.5 * max(float(real.max(initial=0.0)), 0.1), _TABLE)
        table = ideal * (1.0 + self.k1 * ideal**2 + self.k2 * ideal**4)
        folds = np.flatnonzero(np.diff(table) <= 0)
        end = int(folds[0]) + 1 if folds.size else _TABLE
        if table[end - 1] < real.max(initial=0.0):
            raise ValueError("the lens folds the image over: no ray belongs to its corners")
        grown = np.interp(real, table[:end], ideal[:end])
        ratio = np.divide(grown, real, out=np.ones_like(real), where=real > 0)
        return np.stack([x * ratio, y * ratio, np.ones_like(x)], axis=-1)

    def grid(self, rows: slice | None = None) -> Array:
        """Pixel centres of some rows (all by default), (rows, width, 2)."""
        v = np.arange(self.height, dtype=float)[rows or slice(None)]
        u, v = np.meshgrid(np.arange(self.width, dtype=float), v)
        return np.stack([u, v], axis=-1)


def sample_offsets(count: int) -> Array:
    """count^2 places inside a pixel, (count^2, 2) in [0, 1): no two share a column or a row.

    A square grid would see an edge along a pixel row only in `count` steps.
    """
    total = count * count
    step = next(k for k in range(count - 1 or 1, total + 1) if np.gcd(k, total) == 1)
    index = np.arange(total)
    return np.stack([(index + 0.5) / total, (index * step % total + 0.5) / total], axis=-1)


def sample_directions(
    camera: TrueCamera, count: int, rng: np.random.Generator, rows: slice
) -> Floats:
    """Rays of some rows, (rows * width * count^2, 3) float32; each pixel shifts its samples."""
    shift = rng.random((*camera.grid(rows).shape[:2], 1, 2))
    inside = np.mod(sample_offsets(count) + shift, 1.0) - 0.5
    pixels = camera.grid(rows)[:, :, None, :] + inside
    return camera.directions(pixels.reshape(-1, 2)).astype(np.float32)
