"""The 2 x 4 matrix with its index re-mapped from equal angles to equal tangents.

A rotating mirror projects its stripes at nearly equal angles, a pinhole's slide needs equal
tangents. A smooth function of the index corrects that; what is left is that the stripes share no
line.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import least_squares

from bodyscan.arrays import Array
from bodyscan.calibration.pinhole_projector import fit_pinhole
from bodyscan.geometry.light_planes import Axis, LightPlanes
from bodyscan.geometry.robust import spread

POWERS = (3, 4, 5)
"""The matrix itself has a scale, a shift and a perspective of the index: powers 0 to 2."""


def fit_remapped_pinhole(points: Array, s: Array, stripes: int, direction: Axis) -> LightPlanes:
    """Planes of the best 2 x 4 matrix and re-mapping of s (N,) at points (N, 3), camera frame.

    Robust (Cauchy), started from the matrix alone.
    """
    start = fit_pinhole(points, s).matrix
    middle, size = points.mean(axis=0), float(points.std())
    # In units of the point cloud's size and of half the stripes, all unknowns are about 1.
    scale = np.diag([size, size, size, 1.0])
    scale[:3, 3] = middle
    matrix = start @ scale
    half = stripes / 2.0
    matrix[0] = (matrix[0] - half * matrix[1]) / half
    matrix /= np.linalg.norm(matrix[1])
    whole = np.column_stack([(points - middle) / size, np.ones(len(points))])
    index, powers = s / half - 1.0, _powers(s / half - 1.0)

    def residuals(values: Array) -> Array:
        above, below = whole @ values[:4], whole @ values[4:8]
        return np.asarray(above / below - index - powers @ values[8:], np.float64)

    flat = np.concatenate([matrix.ravel(), np.zeros(len(POWERS))])
    noise = spread(residuals(flat))
    solved = least_squares(residuals, flat, loss="cauchy", f_scale=noise, x_scale="jac").x
    u = np.arange(stripes + 1.0) / half - 1.0
    remapped = u + _powers(u) @ solved[8:]
    rows = solved[:4] - remapped[:, None] * solved[4:8]
    return LightPlanes.exact(rows @ np.linalg.inv(scale), direction)


def _powers(u: Array) -> Array:
    """Powers (N, 3) of the index u in [-1, 1]."""
    return np.stack([u**power for power in POWERS], axis=-1)
