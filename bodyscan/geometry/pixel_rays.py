"""Rays through the centres of many pixels of one camera."""

from __future__ import annotations

import numpy as np

from bodyscan.arrays import Array, Mask
from bodyscan.compiled import compiled
from bodyscan.geometry.quadratic_table import Table


def look_up_rays(rays: Table, wanted: Mask, first_row: int = 0) -> Array:
    """Rays (N, 3) through the N pixels that are `wanted` (rows, width), row by row.

    rays: the camera's `ray_table`.
    first_row: the image row of the first row of `wanted`.
    """
    found = np.empty((np.count_nonzero(wanted), 3))
    _look_up_rays(rays, first_row, wanted, found)
    return found


@compiled
def _look_up_rays(table: Table, first_row: int, wanted: Mask, rays: Array) -> None:
    """Fill rays (N, 3) of the N pixels `wanted` (rows, width).

    As `look_up`, but within a row each cell's quadratics are reduced to one variable once.
    """
    c, frame = table
    n = 0
    for v in range(wanted.shape[0]):
        down = (first_row + v - frame[1]) * frame[3]
        i, held = int(down), -1
        y = down - i
        x_0 = x_1 = x_2 = y_0 = y_1 = y_2 = 0.0
        for u in range(wanted.shape[1]):
            if wanted[v, u]:
                across = (u - frame[0]) * frame[2]
                j = int(across)
                if j != held:
                    held, x_2, y_2 = j, c[i, j, 0, 5], c[i, j, 1, 5]
                    x_0 = c[i, j, 0, 0] + y * (c[i, j, 0, 1] + y * c[i, j, 0, 2])
                    y_0 = c[i, j, 1, 0] + y * (c[i, j, 1, 1] + y * c[i, j, 1, 2])
                    x_1, y_1 = c[i, j, 0, 3] + y * c[i, j, 0, 4], c[i, j, 1, 3] + y * c[i, j, 1, 4]
                x = across - j
                rays[n, 0], rays[n, 1] = x_0 + x * (x_1 + x * x_2), y_0 + x * (y_1 + x * y_2)
                rays[n, 2] = 1.0
                n += 1
