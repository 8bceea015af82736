"""A sparse grid: bricks with SIDE nodes per side, kept only where there is something."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bodyscan.arrays import Array, Floats, Mask

SIDE = 8


@dataclass(frozen=True, eq=False)
class Bricks:
    """Places of B bricks, whose values are arrays (B, SIDE, SIDE, SIDE).

    table: (a, b, c) int32, the number of each brick, -1 where there is none.
    places: (B, 3) int32, index of each brick in the table.
    origin: (3,) mm, the grid's first node.
    cell_mm: distance from node to node.
    """

    table: NDArray[np.int32]
    places: NDArray[np.int32]
    origin: Array
    cell_mm: float

    @staticmethod
    def where(wanted: Mask, origin: Array, cell_mm: float) -> Bricks:
        """Keep the wanted bricks (a, b, c) of a grid."""
        places = np.argwhere(wanted).astype(np.int32)
        table = np.full(wanted.shape, -1, np.int32)
        table[wanted] = np.arange(len(places))
        return Bricks(table, places, origin, cell_mm)

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """Shape of an array of values."""
        return len(self.places), SIDE, SIDE, SIDE


def bricks_of(dense: Floats) -> Floats:
    """Values of all nodes of a grid, in bricks; dense: (SIDE a, SIDE b, SIDE c)."""
    a, b, c = (size // SIDE for size in dense.shape)
    split = dense.reshape(a, SIDE, b, SIDE, c, SIDE).transpose(0, 2, 4, 1, 3, 5)
    return np.ascontiguousarray(split).reshape(-1, SIDE, SIDE, SIDE)


def dense_of(values: Floats, shape: tuple[int, ...]) -> Floats:
    """The inverse of `bricks_of`: dense values of all a x b x c bricks, shape (a, b, c)."""
    split = values.reshape(*shape, SIDE, SIDE, SIDE).transpose(0, 3, 1, 4, 2, 5)
    return np.ascontiguousarray(split).reshape([SIDE * size for size in shape])
