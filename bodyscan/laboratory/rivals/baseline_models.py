"""Projectors by their baseline (section 1): stripes perpendicular to it, each with its own angle.

By Eq. 7-9 a light plane is x - tan(tilt) y - tan(angle) z + l = 0, and by Eq. 14 it measures
z = l / (tan(angle) - x/z + tan(tilt) y/z). The invariable baseline (Matsuki and Ueda 1989, Sansoni
et al. 2000) has one l for all stripes, the variable one (Hattori and Sato 1996, Reid 1996) an l for
each. Both assume stripes perpendicular to the baseline: one tilt for all of them, 0 if the baseline
is assumed to be the camera's own axis.
"""

from __future__ import annotations

import numpy as np

from bodyscan.arrays import Array, Indices
from bodyscan.calibration.boundary_points import BoundaryPoints
from bodyscan.geometry.light_planes import Axis, LightPlanes
from bodyscan.geometry.robust import cauchy_weights, spread

FEWEST_POINTS = 12
REWEIGHTINGS = 4
CAUCHY_SIGMAS = 3.0


def fit_invariable_baseline(
    data: BoundaryPoints, stripes: int, direction: Axis, *, fit_tilt: bool = True
) -> LightPlanes:
    """One baseline for all, an angle for each stripe; least squares over all stripes at once.

    fit_tilt: estimate the baseline's direction in the image too; otherwise it is the camera's x
        axis (y for horizontal stripes).

    Boundaries seen at fewer than 12 points get no plane.
    """
    return _fit(data, stripes, direction, own_baseline=False, fit_tilt=fit_tilt)


def fit_variable_baseline(
    data: BoundaryPoints, stripes: int, direction: Axis, *, fit_tilt: bool = True
) -> LightPlanes:
    """A baseline and an angle for each stripe, and one tilt for all; see
    `fit_invariable_baseline`."""
    return _fit(data, stripes, direction, own_baseline=True, fit_tilt=fit_tilt)


def _fit(
    data: BoundaryPoints, stripes: int, direction: Axis, *, own_baseline: bool, fit_tilt: bool
) -> LightPlanes:
    """Linear least squares for x = tan(tilt) y + tan(angle_i) z - l, weighted by how far an error
    of one pixel moves x; points that disagree lose their weight (Cauchy)."""
    x, y, z = _axes(data.points, direction)
    across = np.abs(_axes(data.per_pixel, direction)[0])
    one = np.ones_like(z)
    own = np.stack([z, -one] if own_baseline else [z], axis=1)
    shared = [] if own_baseline else [-one]
    shared += [y] if fit_tilt else []
    common = np.stack(shared, axis=1) if shared else np.zeros((len(x), 0))
    sigma = np.maximum(across, 1e-6) * data.sigma_px
    robust = np.ones(len(x))
    for _ in range(REWEIGHTINGS):
        weights = robust / sigma**2
        each, all_ = _solve(own, common, x, weights, data.index, stripes + 1)
        residuals = x - np.sum(own * each[data.index], axis=1) - common @ all_
        scaled = residuals / sigma
        robust = cauchy_weights(scaled, 1, CAUCHY_SIGMAS * spread(scaled))
    seen = np.bincount(data.index, minlength=stripes + 1) >= FEWEST_POINTS
    baseline = each[:, 1] if own_baseline else np.full(stripes + 1, all_[0])
    tilt = all_[-1] if fit_tilt else 0.0
    return _planes(np.where(seen, each[:, 0], np.nan), baseline, float(tilt), direction)


def _axes(vectors: Array, direction: Axis) -> tuple[Array, Array, Array]:
    """Coordinates across the stripes, along them, and forward."""
    x, y, z = vectors.T
    return (y, x, z) if direction == "horizontal" else (x, y, z)


def _solve(
    own: Array, common: Array, right: Array, weights: Array, group: Indices, groups: int
) -> tuple[Array, Array]:
    """Least squares with K unknowns for each group and M common ones: (groups, K), (M,).

    The groups' own unknowns are eliminated first (Schur complement), so that no large system is
    solved.
    """
    k = own.shape[1]
    whole = np.column_stack([own, common, right])
    size = whole.shape[1]
    gram = np.empty((groups, size, size))
    for i in range(size):
        for j in range(i, size):
            products = np.bincount(group, weights * whole[:, i] * whole[:, j], groups)
            gram[:, i, j] = gram[:, j, i] = products
    taken_out = np.linalg.pinv(gram[:, :k, :k], hermitian=True) @ gram[:, :k, k:]
    rest = (gram[:, k:, k:] - gram[:, k:, :k] @ taken_out).sum(axis=0)
    shared = np.linalg.solve(rest[:-1, :-1], rest[:-1, -1]) if size > k + 1 else np.zeros(0)
    each = taken_out[..., -1] - taken_out[..., :-1] @ shared
    return each, shared


def _planes(slope: Array, baseline: Array, tilt: float, direction: Axis) -> LightPlanes:
    """Planes of the projection angles' tangents `slope` (S + 1,), NaN where there is no plane."""
    across, along = np.ones_like(slope), np.full_like(slope, -tilt)
    first, second = (along, across) if direction == "horizontal" else (across, along)
    planes = np.stack([first, second, -slope, baseline], axis=1)
    planes[~np.isfinite(slope)] = np.nan
    return LightPlanes.exact(planes, direction)
