"""Fit light sheets to stripe boundaries on boards of known pose (3.2, Eq. 15-18): one free plane each,
sheets that are smooth in s, or a projector without a lens as their start."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import numpy as np

from bodyscan.arrays import Array, Indices
from bodyscan.calibration.boundary_points import BoundaryPoints
from bodyscan.compiled import compiled
from bodyscan.geometry.least_squares import EXACT, Block, Noise, minimize
from bodyscan.geometry.light_planes import Axis, LightPlanes, SmoothSheets
from bodyscan.geometry.linear_gaussian import invert_scaled
from bodyscan.geometry.robust import compute_cauchy_weights, estimate_robust_scale

Sheets = TypeVar("Sheets", bound=SmoothSheets)

POINTS = Noise("points on boards", cauchy=3.0, min_scale=1e-3)


def fit_pinhole(points: Array, s: Array) -> Array:
    """Fit a projector without a lens robustly, as a 2 x 4 matrix (Bolles 1981).

    points: (N, 3) on boards, camera frame.
    s: their stripe coordinates (N,).

    Returns (2, 4): s = (row 0 . X) / (row 1 . X), X homogeneous in the camera frame, mm, scaled so
    that the first three numbers of row 1 are a unit vector, the projector's axis. A linear start is
    followed by least squares on s with a Cauchy loss, on at most 20000 points. If all s are one, the
    projector is taken to shine along the plane of the points, from as far away as the camera.
    """
    every = -(-len(points) // 20000)
    points, s = points[::every], s[::every]
    centre, size = points.mean(axis=0), points.std()
    if np.ptp(s) == 0.0:
        normal = np.linalg.svd(points - centre, full_matrices=False)[2][2]
        sheet = np.append(normal, -normal @ centre)
        axis = np.append(centre + sheet[3] * normal, 0.0)
        axis /= np.linalg.norm(axis)
        return np.array([sheet + s[0] * axis, axis])
    scaled = np.column_stack([(points - centre) / size, np.ones(len(points))])
    middle, half = float(np.mean(s)), float(np.std(s))
    t = (s - middle) / half
    rows = np.concatenate([scaled, -t[:, None] * scaled], axis=1)
    _, vectors = np.linalg.eigh(rows.T @ rows)
    start = vectors[:, 0] / np.linalg.norm(vectors[4:7, 0])

    def residuals(flat: Array) -> Array:
        return (scaled @ flat[:4]) / (scaled @ flat[4:]) - t

    from scipy.optimize import least_squares  # imported here because scans do not need it

    scale = 3.0 * estimate_robust_scale(residuals(start), 1e-9)
    solved = least_squares(residuals, start, loss="cauchy", f_scale=scale).x.reshape(2, 4)
    solved[0] = solved[0] * half + middle * solved[1]
    solved[:, :3] /= size
    solved[:, 3] -= solved[:, :3] @ centre
    solved /= np.linalg.norm(solved[1, :3])
    return np.asarray(solved * np.sign(np.sum(points[0] * solved[1, :3]) + solved[1, 3]))


@dataclass(frozen=True, eq=False)
class SheetFit(Generic[Sheets]):
    """Fitted sheets with their covariance."""

    sheets: Sheets
    distances_mm: Array  # of the points from their sheets, (N,)
    weights: Array  # robust weights of the points, (N,)
    noise: float  # robust sigma of the distances, in the points' own sigmas

    @property
    def rms_mm(self) -> float:
        """Robustly weighted root mean square of the distances."""
        return float(np.sqrt(np.average(self.distances_mm**2, weights=self.weights)))


def fit_sheets(
    start: Sheets, data: BoundaryPoints, *, board_error_mm: float = 0.0, max_steps: int = 25
) -> SheetFit[Sheets]:
    """Fit sheets by least squares on offsets of points, with Cauchy loss and the model's prior.

    board_error_mm: how well the boards' poses are known (see `BoardErrors`). It changes only the
        covariance: the errors of a board's points are correlated, however many they are.
    """
    solution = minimize(
        start,
        lambda sheets: _make_blocks(sheets, data),
        lambda sheets, step: sheets.retract(step),
        unknowns=len(start.covariance),
        steps=max_steps,
        tolerance=0.01,  # sheets a tenth of a standard deviation away would be as good
        damping=1e-6,
    )
    sheets, points = solution.state, solution.blocks[0]
    by_point = sheets.offset(data.points, sheets.evaluate(data.index.astype(float))).by_point
    covariance = solution.covariance
    if board_error_mm > 0.0:
        weights = solution.weights[0] / (points.sigma * solution.scales[0]) ** 2
        one = np.zeros_like(data.index)
        (by_boards,) = _compute_board_covariance(
            covariance[None], points.jacobian, by_point, weights, data, one, board_error_mm
        )
        covariance = covariance + by_boards
    return SheetFit(
        replace(sheets, covariance=0.5 * (covariance + covariance.T)),
        points.residuals / np.linalg.norm(by_point, axis=1),
        solution.weights[0],
        solution.scales[0],
    )


def _make_blocks(sheets: SmoothSheets, data: BoundaryPoints) -> tuple[Block, Block]:
    """Residuals: offsets of the points with the sigma that their pixel error gives, and the prior."""
    with np.errstate(all="ignore"):
        at = sheets.evaluate(data.index.astype(float))
        offset = sheets.offset(data.points, at, parameters=True)
    by_parameter = offset.by_parameter
    assert by_parameter is not None
    leverage = np.abs(np.einsum("ni,ni->n", offset.by_point, data.per_pixel))
    # Lens, board and camera are not known to better than 0.02 px, however many pixels were averaged.
    sigma = np.maximum(leverage, 1e-12) * np.hypot(data.sigma_px, 0.02)
    # Sheets that leave points behind the projector are invalid.
    value = np.where(offset.reach > 0.0, offset.value, np.nan)
    known, jacobian = sheets.linearize_prior()
    every = slice(0, jacobian.shape[1])
    return (
        Block(value, lambda: by_parameter, every, POINTS, sigma),
        Block(known, lambda: jacobian, every, EXACT),
    )


def _compute_board_covariance(
    covariance: Array,
    jacobian: Array,
    by_point: Array,
    weights: Array,
    data: BoundaryPoints,
    fit: Indices,
    board_error_mm: float,
) -> Array:
    """Covariance (F, P, P) due to each board's pose error, of F fits of separate points: a sandwich
    estimator with boards as clusters.

    covariance: (F, P, P) due to the noise of the points. jacobian, by_point: derivatives of the offsets
        by the parameters (N, P), by the points (N, 3). weights: inverse variances of the offsets, (N,).
    fit: the fit that each point belongs to, (N,).
    """
    errors, boards = data.board_errors, int(data.board.max()) + 1
    residual = np.einsum("ni,ni->n", by_point, errors.along_ray)
    effects = np.nan_to_num(residual * weights)[:, None] * errors.effects
    cell, cells = fit * boards + data.board, len(covariance) * boards
    by_board = _sum_products(cell, cells, jacobian, effects)
    by_board = by_board.reshape(len(covariance), boards, -1, 3)
    change = board_error_mm * covariance[:, None] @ by_board
    return np.einsum("fbik,fbjk->fij", change, change)


@compiled
def _sum_products(group: Indices, groups: int, left: Array, right: Array) -> Array:
    """Sum left^T right over the rows (N, P) and (N, K) of each group (N,): (groups, P, K)."""
    total = np.zeros((groups, left.shape[1], right.shape[1]))
    for n in range(len(group)):
        for i in range(left.shape[1]):
            for k in range(right.shape[1]):
                total[group[n], i, k] += left[n, i] * right[n, k]
    return total


@dataclass(frozen=True, eq=False)
class PlaneFit:
    """Light planes and how well they fit."""

    planes: LightPlanes
    # Distance of every boundary point from its plane, (N,), NaN without a plane.
    distances_mm: Array
    rms_mm: float  # robustly weighted RMS of the distances


def fit_light_planes(
    data: BoundaryPoints,
    stripes: int,
    direction: Axis,
    *,
    board_error_mm: float = 0.0,
    min_points: int = 12,
) -> PlaneFit:
    """Fit one plane to each boundary on at least two boards, by weighted least squares.

    board_error_mm: how well the boards' poses are known, for the covariance (see `board_errors`).
    min_points: number of points from which a board counts.

    A point is weighted by how far one pixel of error moves it off the plane; outliers lose weight
    (Cauchy). A boundary on a single board, or whose points lie on a line, gets no plane.
    """
    count = stripes + 1
    enough = count_boards(data, stripes, min_points) >= 2
    sigma_mm = np.linalg.norm(data.per_pixel, axis=1) * data.sigma_px
    robust = np.ones(len(data.index))
    for _ in range(4):
        planes, opening, scatter = _fit_weighted_planes(data, robust / sigma_mm**2, count)
        distances = np.sum(data.points * planes[data.index, :3], axis=1) + planes[data.index, 3]
        leverage = np.abs(np.sum(data.per_pixel * planes[data.index, :3], axis=1))
        sigma_mm = np.maximum(leverage, 1e-6) * data.sigma_px
        normalized = distances / sigma_mm
        scale = estimate_robust_scale(normalized[np.isfinite(normalized)], 1e-9)
        robust = np.nan_to_num(compute_cauchy_weights(normalized, 1, 3.0 * scale))
    bad = ~enough | (opening < 1e-4)  # on a line, for all their noise
    planes = np.where(bad[:, None], np.nan, planes)
    distances = np.where(bad[data.index], np.nan, distances)
    used = np.isfinite(distances)
    total = float(np.sum(robust[used]))
    rms = float(np.sqrt(np.sum((robust * distances**2)[used]) / total)) if total else np.nan
    weights = robust / (sigma_mm * scale) ** 2
    covariance = _compute_covariance(planes, scatter / scale**2, data, weights, board_error_mm)
    return PlaneFit(LightPlanes(planes, covariance, direction), distances, rms)


def count_boards(data: BoundaryPoints, stripes: int, min_points: int = 1) -> Indices:
    """Count the boards with at least `min_points` points of each boundary, (S + 1,)."""
    boards = int(data.board.max(initial=0)) + 1
    points = np.bincount(data.index * boards + data.board, minlength=(stripes + 1) * boards)
    return np.count_nonzero(points.reshape(stripes + 1, boards) >= min_points, axis=1)


def _fit_weighted_planes(
    data: BoundaryPoints, weights: Array, count: int
) -> tuple[Array, Array, Array]:
    """Fit planes (count, 4); also return the ratio of the two variances of the points within each
    (0 on a line), and the moments (count, 4, 4)."""
    homogeneous = np.column_stack([data.points, np.ones(len(data.points))])
    moments = _sum_products(data.index, count, homogeneous, weights[:, None] * homogeneous)
    total = np.maximum(moments[:, 3, 3], 1e-300)
    mean = moments[:, :3, 3] / total[:, None]
    scatter = moments[:, :3, :3] / total[:, None, None] - mean[:, :, None] * mean[:, None, :]
    values, vectors = np.linalg.eigh(scatter)
    normals = vectors[:, :, 0]
    offsets = -np.sum(normals * mean, axis=1)
    sign = np.where(offsets < 0.0, -1.0, 1.0)
    planes = np.column_stack([normals, offsets]) * sign[:, None]
    opening = values[:, 1] / np.maximum(values[:, 2], 1e-300)
    return planes, opening, moments


def _compute_covariance(
    planes: Array, moments: Array, data: BoundaryPoints, weights: Array, board_error_mm: float
) -> Array:
    """Covariance (S + 1, 4, 4): the inverse of the weighted normal equations in the planes' three
    degrees of freedom, plus what board errors of board_error_mm add."""
    known = np.isfinite(planes[:, 0])
    covariance = np.full((len(planes), 4, 4), np.nan)
    # A plane's degrees of freedom: two directions perpendicular to the normal, and the offset.
    axes = np.linalg.svd(planes[known, None, :3])[2]
    basis = np.zeros((len(axes), 4, 3))
    basis[:, :3, :2], basis[:, 3, 2] = axes[:, 1:].transpose(0, 2, 1), 1.0
    transposed = basis.transpose(0, 2, 1)
    covariance[known] = basis @ invert_scaled(transposed @ moments[known] @ basis) @ transposed
    if board_error_mm > 0.0:
        homogeneous = np.column_stack([data.points, np.ones(len(data.points))])
        normals = planes[data.index, :3]
        covariance += _compute_board_covariance(
            covariance, homogeneous, normals, weights, data, data.index, board_error_mm
        )
    return covariance
