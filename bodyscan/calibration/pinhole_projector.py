"""The projector as a 2 x 4 matrix (Bolles 1981), by least squares: a rival model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodyscan.arrays import Array
from bodyscan.geometry.lens_sheets import LensSheets
from bodyscan.geometry.light_planes import Axis, LightPlanes
from bodyscan.geometry.robust import robust_scale

MOST_POINTS = 20000


@dataclass(frozen=True, eq=False)
class PinholeProjector:
    """matrix: (2, 4) with s ~ (row 0 . X) / (row 1 . X), X homogeneous in the camera frame, mm.

    Scaled so that the first three numbers of row 1 are a unit vector, the projector's axis.
    """

    matrix: Array

    def stripe(self, points: Array) -> Array:
        """s (...,) of points (..., 3)."""
        above, below = np.moveaxis(points @ self.matrix[:, :3].T + self.matrix[:, 3], -1, 0)
        return above / below

    def sheets(self, points: Array, stripes: int, direction: Axis) -> LensSheets:
        """The same model as a projector without a lens that lights points (N, 3) mm on boards."""
        return LensSheets.from_matrix(self.matrix, points.mean(axis=0), stripes, direction)

    def planes(self, stripes: int, direction: Axis) -> LightPlanes:
        """The same model as light planes, which share one line, through the projector's centre."""
        s = np.arange(stripes + 1.0)[:, None]
        return LightPlanes.from_planes(self.matrix[0] - s * self.matrix[1], direction)


def fit_pinhole(points: Array, s: Array) -> PinholeProjector:
    """Fit robustly to points (N, 3) on boards, camera frame, and their stripe coordinates (N,).

    A linear start is followed by least squares on s with a Cauchy loss, on at most MOST_POINTS.
    """
    every = -(-len(points) // MOST_POINTS)
    points, s = points[::every], s[::every]
    centre, size = points.mean(axis=0), points.std()
    scaled = np.column_stack([(points - centre) / size, np.ones(len(points))])
    middle, half = float(np.mean(s)), float(np.std(s))
    t = (s - middle) / half
    _, vectors = np.linalg.eigh(_moments(np.concatenate([scaled, -t[:, None] * scaled], axis=1)))
    start = vectors[:, 0] / np.linalg.norm(vectors[4:7, 0])

    def residuals(flat: Array) -> Array:
        return (scaled @ flat[:4]) / (scaled @ flat[4:]) - t

    from scipy.optimize import least_squares  # imported here because scans do not need it

    scale = 3.0 * robust_scale(residuals(start), 1e-9)
    solved = least_squares(residuals, start, loss="cauchy", f_scale=scale).x.reshape(2, 4)
    solved[0] = solved[0] * half + middle * solved[1]
    solved[:, :3] /= size
    solved[:, 3] -= solved[:, :3] @ centre
    solved /= np.linalg.norm(solved[1, :3])
    return PinholeProjector(solved * np.sign(np.sum(points[0] * solved[1, :3]) + solved[1, 3]))


def _moments(rows: Array) -> Array:
    return rows.T @ rows
