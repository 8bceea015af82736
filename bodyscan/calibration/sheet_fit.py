"""Fit smooth light sheets, or a pinhole projector as their start, to stripe boundaries on boards."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from bodyscan.arrays import Array
from bodyscan.calibration.boundary_points import BoundaryPoints
from bodyscan.geometry.least_squares import EXACT, Block, Noise, Solution, minimize
from bodyscan.geometry.robust import robust_scale
from bodyscan.geometry.smooth_sheets import SmoothSheets

Sheets = TypeVar("Sheets", bound=SmoothSheets)

POINTS = Noise("points on boards", cauchy=3.0, min_scale=1e-3)


def fit_pinhole(points: Array, s: Array) -> Array:
    """Fit a projector without a lens robustly, as a 2 x 4 matrix (Bolles 1981).

    points: (N, 3) on boards, camera frame.
    s: their stripe coordinates (N,).

    Returns (2, 4): s = (row 0 . X) / (row 1 . X), X homogeneous in the camera frame, mm, scaled so
    that the first three numbers of row 1 are a unit vector, the projector's axis. A linear start is
    followed by least squares on s with a Cauchy loss, on at most 20000 points.
    """
    every = -(-len(points) // 20000)
    points, s = points[::every], s[::every]
    centre, size = points.mean(axis=0), points.std()
    scaled = np.column_stack([(points - centre) / size, np.ones(len(points))])
    middle, half = float(np.mean(s)), float(np.std(s))
    t = (s - middle) / half
    rows = np.concatenate([scaled, -t[:, None] * scaled], axis=1)
    _, vectors = np.linalg.eigh(rows.T @ rows)
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
    return np.asarray(solved * np.sign(np.sum(points[0] * solved[1, :3]) + solved[1, 3]))


@dataclass(frozen=True, eq=False)
class SheetFit(Generic[Sheets]):
    """Fitted sheets with their covariance.

    distances_mm: of the points from their sheets, (N,).
    weights: robust weights of the points, (N,).
    noise: robust sigma of the distances, in the points' own sigmas.
    """

    sheets: Sheets
    distances_mm: Array
    weights: Array
    noise: float

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
    _, jacobian = start.prior()
    solution = minimize(
        start,
        lambda sheets: _blocks(sheets, data),
        lambda sheets, step: sheets.retract(step),
        unknowns=jacobian.shape[1],
        steps=max_steps,
        tolerance=0.01,  # sheets a tenth of a standard deviation away would be as good
        damping=1e-6,
    )
    sheets, points = solution.state, solution.blocks[0]
    by_point = sheets.offset(data.points, sheets.at(data.index.astype(float))).by_point
    covariance = solution.covariance
    if board_error_mm > 0.0:
        covariance = covariance + _board_covariance(solution, data, by_point, board_error_mm)
    return SheetFit(
        sheets.with_covariance(0.5 * (covariance + covariance.T)),
        points.residuals / np.linalg.norm(by_point, axis=1),
        solution.weights[0],
        solution.scales[0],
    )


def _blocks(sheets: SmoothSheets, data: BoundaryPoints) -> tuple[Block, Block]:
    """Residuals: offsets of the points with the sigma that their pixel error gives, and the prior."""
    with np.errstate(all="ignore"):
        at = sheets.at(data.index.astype(float))
        offset = sheets.offset(data.points, at, parameters=True)
    by_parameter = offset.by_parameter
    assert by_parameter is not None
    leverage = np.abs(np.einsum("ni,ni->n", offset.by_point, data.per_pixel))
    # Lens, board and camera are not known to better than 0.02 px, however many pixels were averaged.
    sigma = np.maximum(leverage, 1e-12) * np.hypot(data.sigma_px, 0.02)
    # Sheets that leave points behind the projector are invalid.
    value = np.where(offset.reach > 0.0, offset.value, np.nan)
    known, jacobian = sheets.prior()
    every = slice(0, jacobian.shape[1])
    return (
        Block(value, lambda: by_parameter, every, POINTS, sigma),
        Block(known, lambda: jacobian, every, EXACT),
    )


def _board_covariance(
    solution: Solution[Sheets], data: BoundaryPoints, by_point: Array, board_error_mm: float
) -> Array:
    """Covariance due to each board's pose error: a sandwich estimator with boards as clusters."""
    points, noise = solution.blocks[0], solution.covariance
    errors = data.board_errors
    residual = np.einsum("ni,ni->n", by_point, errors.along_ray)
    weights = solution.weights[0] / (points.sigma * solution.scales[0]) ** 2
    effects = errors.effects * (residual * weights)[:, None]
    total = np.zeros_like(noise)
    for board in np.unique(data.board):
        rows = data.board == board
        change = board_error_mm * noise @ (points.jacobian[rows].T @ effects[rows])
        total += change @ change.T
    return total
