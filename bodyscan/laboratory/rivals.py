"""Rival cameras, from points that are not in one plane, and rival projectors, fitted to stripe
boundaries at known points.

Tsai's camera (1987) has no skew, and one coefficient of its lens, from real to ideal:
ideal = real (1 + kappa r^2). Refined, as he does in the end, it does not depend on the start, which is
a 3 x 4 matrix without a lens (Bolles et al. 1981) here.

By Eq. 7-9 a light plane is x - tan(tilt) y - tan(angle) z + l = 0, and by Eq. 14 it measures
z = l / (tan(angle) - x/z + tan(tilt) y/z). The invariable baseline (Matsuki and Ueda 1989, Sansoni
et al. 2000) has one l for all stripes, the variable one (Hattori and Sato 1996, Reid 1996) an l for
each. Both assume stripes perpendicular to the baseline: one tilt for all of them, 0 if the baseline
is assumed to be the camera's x axis. The pinhole is a 2 x 4 matrix (Bolles et al. 1981).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.linalg import rq
from scipy.optimize import least_squares
from scipy.sparse import csr_array, diags_array, hstack

from bodyscan.arrays import Array
from bodyscan.calibration.boundary_points import BoundaryPoints
from bodyscan.calibration.sheet_fit import fit_pinhole
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses.opencv import Radial
from bodyscan.geometry.light_planes import Axis, LightPlanes
from bodyscan.geometry.robust import compute_cauchy_weights, estimate_robust_scale
from bodyscan.geometry.transforms import RigidTransform


def calibrate_tsai(
    points: Array, pixels: Array, width: int, height: int, *, skewed: bool = False
) -> tuple[Camera, RigidTransform]:
    """Calibrate from points (N, 3) mm, not in one plane, and their pixels (N, 2): the chapter's camera
    whose radial lens is nearest to Tsai's, and camera_from_points.

    skewed: estimate a skew as well, which Tsai's own model lacks.
    """
    rough, pose = split_projection_matrix(estimate_projection_matrix(points, pixels), width, height)
    start = [*pose.twist, rough.beta, rough.alpha / rough.beta, rough.u0, rough.v0, 0.0]
    start += [0.0] * skewed
    solved = least_squares(_compute_residuals, start, x_scale="jac", args=(points, pixels)).x
    focal, aspect, u0, v0, kappa, *skew = solved[6:].tolist()
    camera = Camera(
        focal * aspect, focal, skew[0] if skew else 0.0, u0, v0, Radial(), width, height
    )
    lens = Radial().with_coefficients(_undo_kappa(camera, kappa))
    pose = RigidTransform.from_rotation_vector(solved[:3], solved[3:6])
    return replace(camera, lens=lens), pose


def _undo_kappa(camera: Camera, kappa: float) -> Array:
    """Fit k1 and k2 (2,) that undo kappa best over the camera's image."""
    width, height = camera.width, camera.height
    corners = np.array([[0.0, 0.0], [width, 0.0], [0.0, height], [width, height]])
    away = (corners - [camera.u0, camera.v0]) / [camera.alpha, camera.beta]
    real = np.linspace(0.0, 1.0, 201)[1:] * np.linalg.norm(away, axis=1).max(initial=0.0)
    ideal = real * (1.0 + kappa * real**2)
    # Weighted by the radius, as more of the image lies there.
    rows = np.stack([ideal**3, ideal**5], axis=1) * np.sqrt(real)[:, None]
    return np.linalg.lstsq(rows, (real - ideal) * np.sqrt(real), rcond=None)[0]


def _compute_residuals(values: Array, points: Array, pixels: Array) -> Array:
    """Compute residuals (2 N,) px in the ideal image."""
    focal, aspect, centre, kappa = values[6], values[7], values[8:10], values[10]
    in_camera = RigidTransform.from_rotation_vector(values[:3], values[3:6]).apply(points)
    scale = np.array([focal * aspect, focal])
    real = (pixels - centre) / scale
    if len(values) > 11:
        real[:, 0] -= values[11] / scale[0] * real[:, 1]
    ideal = real * (1.0 + kappa * np.sum(real**2, axis=1, keepdims=True))
    return ((in_camera[:, :2] / in_camera[:, 2:] - ideal) * scale).ravel()


def estimate_projection_matrix(points: Array, pixels: Array) -> Array:
    """Estimate the matrix (3, 4) with pixels (N, 2) ~ P X from points (N, 3) mm not in one plane.

    Direct linear transformation (Abdel-Aziz and Karara 1971) with Hartley's scaling.
    """
    space, image = _compute_scaling(points), _compute_scaling(pixels)
    x = _append_ones(points) @ space.T
    u, v = (_append_ones(pixels) @ image.T)[:, :2].T
    zero = np.zeros_like(x)
    rows = np.block([[x, zero, -u[:, None] * x], [zero, x, -v[:, None] * x]])
    _, vectors = np.linalg.eigh(rows.T @ rows)
    matrix = np.linalg.inv(image) @ vectors[:, 0].reshape(3, 4) @ space
    matrix /= np.linalg.norm(matrix[2, :3])
    return matrix * np.sign(matrix[2] @ np.append(points.mean(axis=0), 1.0))


def split_projection_matrix(
    matrix: Array, width: int, height: int
) -> tuple[Camera, RigidTransform]:
    """Split the matrix into a camera without a lens and camera_from_points."""
    inner, rotation = rq(matrix[:, :3])
    sign = np.diag(np.sign(np.diag(inner)))
    inner, rotation = inner @ sign, sign @ rotation
    translation = np.linalg.solve(inner, matrix[:, 3])
    if np.linalg.det(rotation) < 0.0:
        rotation, translation = -rotation, -translation
    inner = inner / inner[2, 2]
    alpha, gamma, u0, _, beta, v0 = inner[:2].ravel().tolist()
    camera = Camera(alpha, beta, gamma, u0, v0, Radial(), width, height)
    pose = RigidTransform(np.asarray(rotation, np.float64), np.asarray(translation, np.float64))
    return camera, pose


def _compute_scaling(points: Array) -> Array:
    """Compute the matrix (D + 1, D + 1) that scales points to mean 0, mean distance sqrt(D)."""
    size = points.shape[1]
    mean = points.mean(axis=0)
    scale = np.sqrt(size) / float(np.mean(np.linalg.norm(points - mean, axis=1)))
    matrix = np.eye(size + 1)
    matrix[:size] *= scale
    matrix[:size, size] = -scale * mean
    return matrix


def _append_ones(points: Array) -> Array:
    """Append ones to points (N, D)."""
    return np.column_stack([points, np.ones(len(points))])


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
    x, y, z = _split_axes(data.points, direction)
    across = np.abs(_split_axes(data.per_pixel, direction)[0])
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
        robust = compute_cauchy_weights(scaled, 1, 3.0 * estimate_robust_scale(scaled))
    observed = np.bincount(data.index, minlength=count) >= 12
    baseline = solved[count : 2 * count] if variable else np.full(count, solved[count])
    tilt = float(solved[-1]) if fit_tilt else 0.0
    return _build_planes(np.where(observed, solved[:count], np.nan), baseline, tilt, direction)


def _split_axes(vectors: Array, direction: Axis) -> tuple[Array, Array, Array]:
    """Split vectors into coordinates across the stripes, along them, and forward."""
    x, y, z = vectors.T
    return (y, x, z) if direction == "horizontal" else (x, y, z)


def _build_planes(slope: Array, baseline: Array, tilt: float, direction: Axis) -> LightPlanes:
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
    whole = _append_ones((points - middle) / size)
    index, powers = s / half - 1.0, _compute_powers(s / half - 1.0)

    def residuals(values: Array) -> Array:
        above, below = whole @ values[:4], whole @ values[4:8]
        return np.asarray(above / below - index - powers @ values[8:], np.float64)

    flat = np.concatenate([matrix.ravel(), np.zeros(3)])
    noise = estimate_robust_scale(residuals(flat))
    solved = least_squares(residuals, flat, loss="cauchy", f_scale=noise, x_scale="jac").x
    u = np.arange(stripes + 1.0) / half - 1.0
    remapped = u + _compute_powers(u) @ solved[8:]
    rows = solved[:4] - remapped[:, None] * solved[4:8]
    return LightPlanes.from_planes(rows @ np.linalg.inv(scale), direction)


def _compute_powers(u: Array) -> Array:
    """Compute powers 3 to 5 (N, 3) of the index u in [-1, 1]; the matrix has those from 0 to 2."""
    return np.stack([u**power for power in (3, 4, 5)], axis=-1)
