"""The true camera: a pinhole with skew behind a distorting lens (Eq. 1, 3-5).

Written for the simulator alone; it shares nothing with `bodyscan.geometry.camera`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from bodyscan.arrays import Array, Floats
from bodyscan.compiled import compiled


@dataclass(frozen=True)
class TrueCamera:
    """Intrinsics in px, (u, v) = (column, row), whole numbers at pixel centres; camera frame, mm.

    p1, p2, k3: what the chapter's lens lacks: an axis off centre, and the next power.
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
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0

    def image(self, points: Array) -> Array:
        """Project points (..., 3) in front of the camera to px (..., 2)."""
        x, y = points[..., 0] / points[..., 2], points[..., 1] / points[..., 2]
        x, y = distort(x, y, self.k1, self.k2, self.k3, self.p1, self.p2)
        return np.stack([self.alpha * x + self.gamma * y + self.u0, self.beta * y + self.v0], -1)

    def directions(self, pixels: Array) -> Array:
        """Compute ray directions (..., 3), camera frame, z = 1, of px (..., 2)."""
        y = (pixels[..., 1] - self.v0) / self.beta
        x = (pixels[..., 0] - self.u0 - self.gamma * y) / self.alpha
        ideal = np.stack([x, y], axis=-1).reshape(-1, 2)
        if not undistort_points(ideal, np.array([self.k1, self.k2, self.k3, self.p1, self.p2])):
            raise ValueError("the lens folds the image over: no ray belongs to its corners")
        return np.append(ideal, np.ones((len(ideal), 1)), axis=1).reshape(*x.shape, 3)

    def grid(self, rows: slice | None = None) -> Array:
        """List pixel centres of some rows (all by default), (rows, width, 2)."""
        v = np.arange(self.height, dtype=float)[rows or slice(None)]
        u, v = np.meshgrid(np.arange(self.width, dtype=float), v)
        return np.stack([u, v], axis=-1)


def distort(
    x: Any, y: Any, k1: float, k2: float, k3: float, p1: float, p2: float
) -> tuple[Any, Any]:
    """Distort normalised coordinates, numbers or arrays (Brown 1966)."""
    square = x * x + y * y
    scale = 1.0 + square * (k1 + square * (k2 + square * k3))
    aside = 2.0 * p1 * x * y + p2 * (square + 2.0 * (x * x))
    down = p1 * (square + 2.0 * (y * y)) + 2.0 * p2 * x * y
    return x * scale + aside, y * scale + down


_distort = compiled(distort)


@compiled
def undistort_points(points: Array, lens: Array) -> bool:
    """Replace points (N, 2) by what the lens (k1, k2, k3, p1, p2) maps to them.

    By Newton's method with numerical slopes. Returns False, with points undefined, if the lens
    folds the image over.
    """
    k1, k2, k3, p1, p2 = lens
    step = 1e-6
    for i in range(len(points)):
        u, v = points[i]
        x, y = u, v
        for _ in range(6):  # distortion is some 0.1, and each step squares the error
            image_x, image_y = _distort(x, y, k1, k2, k3, p1, p2)
            right_x, right_y = _distort(x + step, y, k1, k2, k3, p1, p2)
            below_x, below_y = _distort(x, y + step, k1, k2, k3, p1, p2)
            xx, yx = (right_x - image_x) / step, (right_y - image_y) / step
            xy, yy = (below_x - image_x) / step, (below_y - image_y) / step
            size = xx * yy - yx * xy
            if size <= 0:
                return False
            short_x, short_y = u - image_x, v - image_y
            x, y = (
                x + (short_x * yy - short_y * xy) / size,
                y + (short_y * xx - short_x * yx) / size,
            )
        points[i, 0], points[i, 1] = x, y
    return True


def sample_offsets(count: int) -> Array:
    """Space count^2 positions in a pixel, (count^2, 2) in [0, 1): none share a column or a row.

    A square grid would resolve an edge along a row of pixels in only `count` steps.
    """
    total = count * count
    step = next(k for k in range(count - 1 or 1, total + 1) if np.gcd(k, total) == 1)
    index = np.arange(total)
    return np.stack([(index + 0.5) / total, (index * step % total + 0.5) / total], axis=-1)


def sample_directions(camera: TrueCamera, count: int, shift: Array, rows: slice) -> Floats:
    """Compute rays of rows, (rows * width * count^2, 3); `shift` (rows, width, 2) moves the samples."""
    inside = np.mod(sample_offsets(count) + shift[:, :, None], 1.0) - 0.5
    pixels = camera.grid(rows)[:, :, None, :] + inside
    return camera.directions(pixels.reshape(-1, 2)).astype(np.float32)
