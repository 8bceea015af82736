"""Light planes from stripe boundaries on boards of known pose (3.2, Eq. 15-18)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodyscan.arrays import Array, Indices
from bodyscan.calibration.boundary_points import (
    BoundaryPoints,
    boundary_points,
    concatenate,
    points_on_board,
)
from bodyscan.geometry.light_planes import Axis, LightPlanes
from bodyscan.geometry.linear_gaussian import invert_scaled
from bodyscan.geometry.robust import cauchy_weights, robust_scale

__all__ = [
    "BoundaryPoints",
    "PlaneFit",
    "boundary_points",
    "concatenate",
    "fit_light_planes",
    "points_on_board",
]


FEWEST_POINTS = 12
LEAST_OPENING = 1e-4
REWEIGHTINGS = 4
CAUCHY_SIGMAS = 3.0


@dataclass(frozen=True, eq=False)
class PlaneFit:
    """Light planes and how well they fit.

    distances_mm: distance of every boundary point from its plane, (N,), NaN without a plane.
    rms_mm: robustly weighted RMS of the distances.
    """

    planes: LightPlanes
    distances_mm: Array
    rms_mm: float


def fit_light_planes(
    data: BoundaryPoints,
    stripes: int,
    direction: Axis,
    *,
    board_error_mm: float = 0.0,
    fewest_points: int = FEWEST_POINTS,
) -> PlaneFit:
    """Fit one plane to each boundary seen on at least two boards, by weighted least squares.

    board_error_mm: how well the boards' poses are known, for the covariance (see `board_errors`).
    fewest_points: points from which a board counts.

    A point is weighted by how far one pixel of error moves it off the plane; outliers lose weight
    (Cauchy). A boundary seen on a single board, or whose points lie on a line, gets no plane.
    """
    count = stripes + 1
    enough = _boards_seen(data, count, fewest_points) >= 2
    spread_mm = np.linalg.norm(data.per_pixel, axis=1) * data.sigma_px
    robust = np.ones(len(data.index))
    for _ in range(REWEIGHTINGS):
        planes, opening, scatter = _weighted_planes(data, robust / spread_mm**2, count)
        distances = np.sum(data.points * planes[data.index, :3], axis=1) + planes[data.index, 3]
        leverage = np.abs(np.sum(data.per_pixel * planes[data.index, :3], axis=1))
        spread_mm = np.maximum(leverage, 1e-6) * data.sigma_px
        normalized = distances / spread_mm
        scale = robust_scale(normalized[np.isfinite(normalized)], 1e-9)
        robust = np.nan_to_num(cauchy_weights(normalized, 1, CAUCHY_SIGMAS * scale))
    bad = ~enough | (opening < LEAST_OPENING)
    planes = np.where(bad[:, None], np.nan, planes)
    distances = np.where(bad[data.index], np.nan, distances)
    used = np.isfinite(distances)
    total = float(np.sum(robust[used]))
    rms = float(np.sqrt(np.sum((robust * distances**2)[used]) / total)) if total else np.nan
    weights = robust / (spread_mm * scale) ** 2
    covariance = _covariance(planes, scatter / scale**2, data, weights, board_error_mm)
    return PlaneFit(LightPlanes(planes, covariance, direction), distances, rms)


def _boards_seen(data: BoundaryPoints, count: int, fewest: int) -> Indices:
    boards = int(data.board.max()) + 1 if len(data.board) else 1
    points = np.bincount(data.index * boards + data.board, minlength=count * boards)
    return np.sum(points.reshape(count, boards) >= fewest, axis=1)


def _weighted_planes(
    data: BoundaryPoints, weights: Array, count: int
) -> tuple[Array, Array, Array]:
    """Planes (count, 4), how far their points extend off a line, and moments (count, 4, 4)."""
    homogeneous = np.column_stack([data.points, np.ones(len(data.points))])
    moments = np.empty((count, 4, 4))
    for i in range(4):
        for j in range(i, 4):
            products = weights * homogeneous[:, i] * homogeneous[:, j]
            moments[:, i, j] = moments[:, j, i] = np.bincount(data.index, products, count)
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


def _covariance(
    planes: Array, moments: Array, data: BoundaryPoints, weights: Array, board_error_mm: float
) -> Array:
    """Covariance (S + 1, 4, 4): the inverse of the weighted normal equations in the planes' three
    degrees of freedom, plus what board errors of board_error_mm add."""
    known = np.isfinite(planes[:, 0])
    covariance = np.full((len(planes), 4, 4), np.nan)
    normals = planes[known, :3]
    # A plane's degrees of freedom: two directions perpendicular to the normal, and the offset.
    helper = np.where(np.abs(normals[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    first = np.cross(normals, helper)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    basis = np.zeros((len(normals), 4, 3))
    basis[:, :3, 0], basis[:, :3, 1] = first, np.cross(normals, first)
    basis[:, 3, 2] = 1.0
    transposed = basis.transpose(0, 2, 1)
    inverse = basis @ invert_scaled(transposed @ moments[known] @ basis)
    inverse = inverse @ transposed
    covariance[known] = inverse
    if board_error_mm > 0.0:
        pulled = inverse[:, None] @ _board_pull(planes, data, weights)[known]
        spread = np.einsum("nbik,nbjk->nij", pulled, pulled)
        covariance[known] += board_error_mm**2 * spread
    return covariance


def _board_pull(planes: Array, data: BoundaryPoints, weights: Array) -> Array:
    """(S + 1, boards, 4, 3): how 1 mm of each board error pulls on each plane."""
    errors = data.board_errors
    off = np.sum(planes[data.index, :3] * errors.along_ray, axis=1)
    effects = np.nan_to_num(off * weights)[:, None] * errors.effects
    homogeneous = np.column_stack([data.points, np.ones(len(data.points))])
    boards = int(data.board.max()) + 1
    cell, cells = data.index * boards + data.board, len(planes) * boards
    pull = np.empty((cells, 4, 3))
    for i in range(4):
        for j in range(3):
            pull[:, i, j] = np.bincount(cell, homogeneous[:, i] * effects[:, j], cells)
    return pull.reshape(len(planes), boards, 4, 3)
