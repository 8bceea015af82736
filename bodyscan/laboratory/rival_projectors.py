"""Rival models of the projector, fitted to stripe boundaries at known points.

By Eq. 7-9 a light plane is x - tan(tilt) y - tan(angle) z + l = 0, and by Eq. 14 it measures
z = l / (tan(angle) - x/z + tan(tilt) y/z). The invariable baseline (Matsuki and Ueda 1989, Sansoni
et al. 2000) has one l for all stripes, the variable one (Hattori and Sato 1996, Reid 1996) an l for
each. Both assume stripes perpendicular to the baseline: one tilt for all of them, 0 if the baseline
is assumed to be the camera's per_stripe axis. The pinhole is a 2 x 4 matrix (Bolles et al. 1981).
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import least_squares
from scipy.sparse import csr_array, diags_array, hstack

from bodyscan.arrays import Array
from bodyscan.calibration.boundary_points import BoundaryPoints
from bodyscan.calibration.sheet_fit import fit_pinhole
from bodyscan.geometry.light_planes import Axis, LightPlanes
from bodyscan.geometry.robust import cauchy_weights, robust_scale


def fit_baseline(
    data: BoundaryPoints, stripes: int, direction: Axis, *, variable: bool, fit_tilt: bool = True
) -> LightPlanes:
    """Fit an angle for each stripe, and one baseline for all or one for each (`variable`).

    fit_tilt: estimate the baseline's direction in the image too; otherwise it is the camera's x
        axis (y for horizontal stripes).

    Boundaries observed at fewer than 12 points get no plane.
    """
    # Linear least squares for x = tan(tilt) y + tan(angle_i) z - l, weighted by how far an error of
    # one pixel moves x; points that disagree lose their weight (Cauchy).
    x, y, z = _axes(data.points, direction)
    across = np.abs(_axes(data.per_pixel, direction)[0])
    count, one = stripes + 1, np.ones_like(z)
    rows = np.arange(len(x))
    columns = [csr_array((z, (rows, data.index)), shape=(len(x), count))]
    shared = data.index if variable else np.zeros_like(data.index)
    columns += [csr_array((-one, (rows, shared)), shape=(len(x), count if variable else 1))]
    columns += [csr_array(y[:, None])] if fit_tilt else []
    design = hstack(columns).tocsr()
    sigma = np.maximum(across, 1e-6) * data.sigma_px
    robust = one
    for _ in range(4):
        weights = robust / sigma**2
        normal = (design.T @ (diags_array(weights) @ design)).toarray()
        # Of least norm: 0 for stripes that no board shows.
        right = np.asarray(design.T @ (weights * x))
        solved = np.linalg.lstsq(normal, right, rcond=None)[0]
        scaled = (x - design @ solved) / sigma
        robust = cauchy_weights(scaled, 1, 3.0 * robust_scale(scaled))
    observed = np.bincount(data.index, minlength=count) >= 12
    baseline = solved[count : 2 * count] if variable else np.full(count, solved[count])
    tilt = float(solved[-1]) if fit_tilt else 0.0
    return _planes(np.where(observed, solved[:count], np.nan), baseline, tilt, direction)


def _axes(vectors: Array, direction: Axis) -> tuple[Array, Array, Array]:
    """Split vectors into coordinates across the stripes, along them, and forward."""
    x, y, z = vectors.T
    return (y, x, z) if direction == "horizontal" else (x, y, z)


def _planes(slope: Array, baseline: Array, tilt: float, direction: Axis) -> LightPlanes:
    """Build planes from the tangents `slope` (S + 1,) of projection angles, NaN for none."""
    across, along = np.ones_like(slope), np.full_like(slope, -tilt)
    first, second = (along, across) if direction == "horizontal" else (across, along)
    planes = np.stack([first, second, -slope, baseline], axis=1)
    planes[~np.isfinite(slope)] = np.nan
    return LightPlanes.from_planes(planes, direction)


def fit_remapped_pinhole(points: Array, s: Array, stripes: int, direction: Axis) -> LightPlanes:
    """Fit a 2 x 4 matrix and a re-mapping of s (N,) to points (N, 3), camera frame.

    Robust (Cauchy), started from the matrix alone.
    """
    start = fit_pinhole(points, s)
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

    flat = np.concatenate([matrix.ravel(), np.zeros(3)])
    noise = robust_scale(residuals(flat))
    solved = least_squares(residuals, flat, loss="cauchy", f_scale=noise, x_scale="jac").x
    u = np.arange(stripes + 1.0) / half - 1.0
    remapped = u + _powers(u) @ solved[8:]
    rows = solved[:4] - remapped[:, None] * solved[4:8]
    return LightPlanes.from_planes(rows @ np.linalg.inv(scale), direction)


def _powers(u: Array) -> Array:
    """Compute powers 3 to 5 (N, 3) of the index u in [-1, 1]; the matrix has those from 0 to 2."""
    return np.stack([u**power for power in (3, 4, 5)], axis=-1)
