"""A coarse picture of the surface that one pair saw: a plane in each cell of some pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodyscan.arrays import Array, Indices

FEWEST = 6
LEAST_SPREAD = 0.15
"""Of a cell, standard deviation of its places each way: less tells no slope."""
MOST_ROUGH_MM = 3.0
"""Where points are this far off their cell's plane, RMS, there are two surfaces in it: limbs are 30 mm
thick and more, and what a cell of 16 px cuts off a finger bends by less."""


@dataclass(frozen=True)
class Cells:
    """An image of width x height px cut into cells of `px` x `px`."""

    width: int
    height: int
    px: int

    @property
    def shape(self) -> tuple[int, int]:
        """Rows, columns."""
        return -(-self.height // self.px), -(-self.width // self.px)

    @property
    def count(self) -> int:
        return self.shape[0] * self.shape[1]

    @property
    def middles(self) -> tuple[Array, Array]:
        """Of columns and rows of cells, px."""
        rows, columns = (np.arange(0.5 * self.px, n * self.px, self.px) - 0.5 for n in self.shape)
        return columns, rows

    def of(self, pixels: Array) -> Indices:
        """(...) flat number of the cell that places (..., 2) px lie in."""
        rows, columns = self.shape
        place = np.floor((pixels + 0.5) / self.px).astype(np.int64)
        row, column = np.clip(place[..., 1], 0, rows - 1), np.clip(place[..., 0], 0, columns - 1)
        return np.asarray(row * columns + column, np.int64)


def fit_planes(
    cells: Cells, pixels: Array, rays: Array, depth: Array, weights: Array
) -> tuple[Array, Array]:
    """(cells, 3) each: p of each cell's plane p.P = 1, camera frame, 1/mm, and P in the middle of
    what was seen of it; NaN where none is known.

    From places (N, 2) px with rays (N, 3), z = 1, and depths (N,) mm: 1/z = p.x along the ray x, so
    that the fit is linear.  weights: (N,), of what else is averaged over the same places.
    """
    cell = cells.of(pixels)
    count = np.bincount(cell, minlength=cells.count)
    total = np.maximum(np.bincount(cell, weights, cells.count), 1e-300)

    def mean(values: Array) -> Array:
        return np.asarray(np.bincount(cell, weights * values, cells.count) / total, np.float64)

    x, y, inverse = mean(rays[:, 0]), mean(rays[:, 1]), mean(1.0 / depth)
    across, down, off = rays[:, 0] - x[cell], rays[:, 1] - y[cell], 1.0 / depth - inverse[cell]
    xx, xy, yy = mean(across * across), mean(across * down), mean(down * down)
    xq, yq, qq = mean(across * off), mean(down * off), mean(off * off)
    determinant = xx * yy - xy * xy
    with np.errstate(divide="ignore", invalid="ignore"):
        by_x = (yy * xq - xy * yq) / determinant
        by_y = (xx * yq - xy * xq) / determinant
        rough = np.sqrt(np.maximum(qq - by_x * xq - by_y * yq, 0.0)) / inverse**2
        planes = np.stack([by_x, by_y, inverse - by_x * x - by_y * y], axis=-1)
    width = cells.px * _ray_step(pixels, rays)
    spread = np.sqrt(np.maximum(determinant, 0.0)) > (LEAST_SPREAD * width) ** 2
    planes[~((count >= FEWEST) & spread & (rough < MOST_ROUGH_MM))] = np.nan
    points = np.stack([x, y, np.ones_like(x)], axis=-1) / np.maximum(inverse, 1e-300)[:, None]
    return planes, points


def _ray_step(pixels: Array, rays: Array) -> float:
    """How far rays move at z = 1 from a pixel to the next, on the whole."""
    moved = np.prod(np.std(rays[:, :2], axis=0)) / max(np.prod(np.std(pixels, axis=0)), 1e-12)
    return float(np.sqrt(moved))
