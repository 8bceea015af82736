"""A camera as two lookup tables, independent of its lens, for compiled loops; rays of many pixels;
which points lie in the image.

A table holds a smooth map between planes, pixels to rays or rays to pixels, a quadratic per cell.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np

from bodyscan.arrays import Array, Mask
from bodyscan.compiled import compiled
from bodyscan.geometry.camera import Camera

Table = tuple[Array, Array]
"""Coefficients (rows, columns, 2, 6) of x^i y^j, both from 0 to 1 across a cell, whose outermost cells
form a ring around the tabulated rectangle that means "outside"; and (4,) the ring's least x and y,
then cells per unit of x and of y."""

POWERS = ((0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (2, 0))
"""Powers of x and y that belong to a cell's six coefficients."""
NODES = 0.5 + 0.5 * np.cos(np.pi * (np.arange(3) + 0.5) / 3.0)
"""Chebyshev nodes across a cell of width 1: a fit there has about the same error everywhere."""


def fit_table(
    function: Callable[[Array], Array],
    low: Array,
    high: Array,
    cells: tuple[int, int],
    outside: float,
) -> tuple[Table, float]:
    """Tabulate a function by least squares at 3 x 3 nodes of each cell.

    function: takes places (..., 2) to values (..., 2).
    low, high: (2,) limits of the tabulated rectangle.
    cells: number of columns and rows.
    outside: both values elsewhere, and in cells where the function is NaN at some node.

    Also returns the largest deviation of a quadratic from a fitted value, in the values' unit.
    """
    size = (high - low) / cells
    x, y = (grid.ravel() for grid in np.meshgrid(NODES, NODES))
    corner = np.stack(np.meshgrid(np.arange(cells[0]), np.arange(cells[1])), axis=-1)
    values = function(low + size * (corner[:, :, None] + np.stack([x, y], axis=-1)))
    monomials = np.stack([x**i * y**j for i, j in POWERS], axis=-1)
    coefficients = np.swapaxes(np.linalg.pinv(monomials) @ values, -1, -2)
    error = np.abs(coefficients @ monomials.T - np.swapaxes(values, -1, -2))
    ringed = np.zeros((cells[1] + 2, cells[0] + 2, 2, len(POWERS)))
    ringed[..., 0] = outside
    known = np.isfinite(coefficients).all(axis=(2, 3))
    ringed[1:-1, 1:-1][known] = coefficients[known]
    frame = np.concatenate([low - size, 1.0 / size])
    return (ringed, frame), float(error[known].max(initial=0.0))


@compiled
def look_up(table: Table, x: float, y: float) -> tuple[float, float]:
    """The two values at (x, y).

    Without a branch: with one, Numba counts references to the arrays, which takes longest.
    """
    cells = table[0]
    row, column, x, y = _locate_cell(table, x, y)
    return _quadratic(cells, row, column, 0, x, y), _quadratic(cells, row, column, 1, x, y)


@compiled
def look_up_derivatives(table: Table, x: float, y: float) -> tuple[float, float, float, float]:
    """Derivatives of the first value by x and y, then of the second, at (x, y)."""
    cells, frame = table
    row, column, x, y = _locate_cell(table, x, y)
    a, b = _derivatives(cells, row, column, 0, x, y)
    c, d = _derivatives(cells, row, column, 1, x, y)
    return a * frame[2], b * frame[3], c * frame[2], d * frame[3]


@compiled
def _locate_cell(table: Table, x: float, y: float) -> tuple[int, int, float, float]:
    """Row and column of the cell that holds (x, y), and the place in it."""
    cells, frame = table
    across, down = (x - frame[0]) * frame[2], (y - frame[1]) * frame[3]
    column = min(max(int(across), 0), cells.shape[1] - 1)
    row = min(max(int(down), 0), cells.shape[0] - 1)
    return row, column, across - column, down - row


@compiled
def _quadratic(c: Array, i: int, j: int, k: int, x: float, y: float) -> float:
    by_x = c[i, j, k, 3] + y * c[i, j, k, 4] + x * c[i, j, k, 5]
    return c[i, j, k, 0] + y * (c[i, j, k, 1] + y * c[i, j, k, 2]) + x * by_x


@compiled
def _derivatives(c: Array, i: int, j: int, k: int, x: float, y: float) -> tuple[float, float]:
    return (
        c[i, j, k, 3] + y * c[i, j, k, 4] + 2.0 * x * c[i, j, k, 5],
        c[i, j, k, 1] + x * c[i, j, k, 4] + 2.0 * y * c[i, j, k, 2],
    )


MARGIN_PX = 1.5
"""Extent of the table beyond the outermost pixel centres: outside it is outside the image."""
OUTSIDE = -2.0
"""Both values of the projection table where it has none: no pixel has these coordinates."""
CAMERAS = 64  # cached: enough for a few rigs


@lru_cache(CAMERAS)
def make_projection_table(camera: Camera) -> Table:
    """From ideal normalised (x, y) to the pixel (u, v); OUTSIDE where no ray of the image goes.

    Far outside its image a lens may fold back: such points have no pixel here, although
    `Camera.project` gives them one.
    """
    u, v = (np.linspace(-MARGIN_PX, n - 1.0 + MARGIN_PX, 33) for n in (camera.width, camera.height))
    ideal = camera.rays(np.stack(np.meshgrid(u, v), axis=-1)).reshape(-1, 3)[:, :2]
    fold_radius = camera.lens.fold_radius

    def pixels(normalized: Array) -> Array:
        found = camera.pixels_from_normalized(camera.lens.distort(normalized))
        one_to_one = np.linalg.norm(normalized, axis=-1, keepdims=True) < fold_radius
        return np.where(one_to_one, found, np.nan)

    low, high = np.nanmin(ideal, axis=0), np.nanmax(ideal, axis=0)
    return _fit_within_tolerance(camera, pixels, low, high, 1.0, OUTSIDE)


@lru_cache(CAMERAS)
def make_ray_table(camera: Camera) -> Table:
    """From a pixel (u, v) of the image to the (x, y) of its ray (x, y, 1); NaN where the lens folds."""
    last = np.array([camera.width, camera.height]) - 0.5

    def ideal(pixels: Array) -> Array:
        return camera.rays(pixels)[..., :2]

    return _fit_within_tolerance(camera, ideal, np.full(2, -0.5), last, camera.alpha, np.nan)


def _fit_within_tolerance(
    camera: Camera,
    function: Callable[[Array], Array],
    low: Array,
    high: Array,
    px_per_unit: float,
    outside: float,
) -> Table:
    # In px: the first is enough for a scanner's lens; the last holds one that nearly folds to 1e-3 px.
    for cell in (32, 16, 8):
        cells = -(-camera.width // cell), -(-camera.height // cell)
        table, error = fit_table(function, low, high, cells, outside)
        # A five-hundredth of the precision to which corners and boundaries are found.
        if error * px_per_unit < 1e-4:
            break
    return table


@compiled
def look_up_rays(table: Table, wanted: Mask, first_row: int = 0) -> Array:
    """Rays (N, 3) through the N pixels that are `wanted` (rows, width), row by row.

    table: the camera's `make_ray_table`.
    first_row: the image row of the first row of `wanted`.
    """
    rays, n = np.ones((np.count_nonzero(wanted), 3)), 0
    for v in range(wanted.shape[0]):
        for u in range(wanted.shape[1]):
            if wanted[v, u]:
                rays[n, 0], rays[n, 1] = look_up(table, float(u), float(first_row + v))
                n += 1
    return rays


def is_in_image(camera: Camera, points: Array) -> Mask:
    """Whether points (..., 3), camera frame, lie ahead of the camera and inside its image, (...).

    Far outside its image a lens may fold back, so that points which the camera cannot see project
    inside: the rays of those pixels lead elsewhere.
    """
    ahead = points[..., 2] > 0.0
    safe = np.where(ahead[..., None], points, [0.0, 0.0, 1.0])
    pixels = camera.project(safe)
    last = np.array([camera.width - 1.0, camera.height - 1.0])
    inside = ahead & np.all((pixels >= 0.0) & (pixels <= last), axis=-1)
    rays = camera.rays(np.where(inside[..., None], pixels, 0.0))
    return inside & np.all(np.abs(rays - safe / safe[..., 2:3]) < 1e-6, axis=-1)
