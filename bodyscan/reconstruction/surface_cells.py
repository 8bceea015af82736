"""A coarse model of the surface that one pair saw: a plane in each cell of some pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodyscan.arrays import Array, Indices

FEWEST = 6
LEAST_SPREAD = 0.15
"""Least standard deviation of places in a cell, relative to its width: less determines no slope."""
MOST_ROUGH_MM = 3.0
"""A cell whose points are this far off its plane, RMS, contains two surfaces: limbs are 30 mm thick
or more, and the part of a finger in a cell of 16 px bends by less."""


@dataclass(frozen=True)
class Cells:
    """An image of width x height px, divided into cells of `px` x `px`."""

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
        """Middles of the columns and rows of cells, px."""
        rows, columns = (np.arange(0.5 * self.px, n * self.px, self.px) - 0.5 for n in self.shape)
        return columns, rows

    def of(self, pixels: Array) -> Indices:
        """Flat number (...) of the cell in which places (..., 2) px lie."""
        rows, columns = self.shape
        place = np.floor((pixels + 0.5) / self.px).astype(np.int64)
        row, column = np.clip(place[..., 1], 0, rows - 1), np.clip(place[..., 0], 0, columns - 1)
        return np.asarray(row * columns + column, np.int64)


def fit_planes(
    cells: Cells, pixels: Array, rays: Array, depth: Array, weights: Array
) -> tuple[Array, Array]:
    """Fit a plane to each cell, camera frame.

    pixels: places, (N, 2) px.
    rays: of these places, z = 1, (N, 3).
    depth: (N,) mm.
    weights: (N,), those of anything else averaged over the same places.

    Returns (cells, 3) each: p of the plane p.P = 1, 1/mm, and P in the middle of what was seen of
    it; NaN where unknown. Along the ray x, 1/z = p.x, so the fit is linear.
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
    """Typical distance between the rays of neighbouring pixels at z = 1."""
    moved = np.prod(np.std(rays[:, :2], axis=0)) / max(np.prod(np.std(pixels, axis=0)), 1e-12)
    return float(np.sqrt(moved))
