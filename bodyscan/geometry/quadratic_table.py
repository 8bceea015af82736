"""A smooth map from the plane to the plane, tabulated as one quadratic per cell.

Compiled loops use it in place of a camera: pixels to rays and rays to pixels, whatever the lens.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from bodyscan.arrays import Array
from bodyscan.compiled import compiled

Table = tuple[Array, Array]
"""Coefficients and frame of a `QuadraticTable`, for compiled functions."""

POWERS = ((0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (2, 0))
"""Powers of x and y that belong to a cell's six coefficients."""
NODES = 0.5 + 0.5 * np.cos(np.pi * (np.arange(3) + 0.5) / 3.0)
"""Chebyshev nodes across a cell of width 1: a fit there has about the same error everywhere."""


@dataclass(frozen=True, eq=False)
class QuadraticTable:
    """A tabulated map with two values.

    coefficients: (rows, columns, 2, 6) of x^i y^j, both from 0 to 1 across a cell. The outermost
        cells form a ring around the tabulated rectangle that means "outside".
    frame: (4,) the ring's least x and y, then cells per unit of x and of y.
    error: the largest deviation of a quadratic from a fitted value, in the values' unit.
    """

    coefficients: Array
    frame: Array
    error: float

    @property
    def table(self) -> Table:
        return self.coefficients, self.frame

    @staticmethod
    def fit(
        function: Callable[[Array], Array],
        low: Array,
        high: Array,
        cells: tuple[int, int],
        outside: float,
    ) -> QuadraticTable:
        """Tabulate a function by least squares at 3 x 3 nodes of each cell.

        function: takes places (..., 2) to values (..., 2).
        low, high: (2,) limits of the tabulated rectangle.
        cells: number of columns and rows.
        outside: both values elsewhere, and in cells where the function is NaN at some node.
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
        worst = float(error[known].max(initial=0.0))
        return QuadraticTable(ringed, np.concatenate([low - size, 1.0 / size]), worst)


@compiled
def look_up(table: Table, x: float, y: float) -> tuple[float, float]:
    """The two values at (x, y).

    Without a branch: with one, Numba counts references to the arrays, which takes longer than all
    the rest.
    """
    cells, frame = table
    across, down = (x - frame[0]) * frame[2], (y - frame[1]) * frame[3]
    column = min(max(int(across), 0), cells.shape[1] - 1)
    row = min(max(int(down), 0), cells.shape[0] - 1)
    x, y = across - column, down - row
    return _quadratic(cells, row, column, 0, x, y), _quadratic(cells, row, column, 1, x, y)


@compiled
def look_up_derivatives(table: Table, x: float, y: float) -> tuple[float, float, float, float]:
    """Derivatives of the first value by x and y, then of the second, at (x, y)."""
    cells, frame = table
    across, down = (x - frame[0]) * frame[2], (y - frame[1]) * frame[3]
    column = min(max(int(across), 0), cells.shape[1] - 1)
    row = min(max(int(down), 0), cells.shape[0] - 1)
    x, y = across - column, down - row
    a, b = _derivatives(cells, row, column, 0, x, y)
    c, d = _derivatives(cells, row, column, 1, x, y)
    return a * frame[2], b * frame[3], c * frame[2], d * frame[3]


@compiled
def _quadratic(c: Array, i: int, j: int, k: int, x: float, y: float) -> float:
    return (
        c[i, j, k, 0]
        + y * (c[i, j, k, 1] + y * c[i, j, k, 2])
        + x * (c[i, j, k, 3] + y * c[i, j, k, 4] + x * c[i, j, k, 5])
    )


@compiled
def _derivatives(c: Array, i: int, j: int, k: int, x: float, y: float) -> tuple[float, float]:
    return (
        c[i, j, k, 3] + y * c[i, j, k, 4] + 2.0 * x * c[i, j, k, 5],
        c[i, j, k, 1] + x * c[i, j, k, 4] + 2.0 * y * c[i, j, k, 2],
    )
