"""Fit smooth light sheets to stripe boundaries on boards, with their covariance."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from bodyscan.arrays import Array
from bodyscan.calibration.boundary_points import BoundaryPoints
from bodyscan.geometry.least_squares import EXACT, Block, Noise, Solution, minimize
from bodyscan.geometry.smooth_sheets import SmoothSheets

Sheets = TypeVar("Sheets", bound=SmoothSheets)

MOST_STEPS = 25
SETTLED = 0.01
"""Convergence, in variances: sheets a tenth of a standard deviation away would be as good."""
POINTS = Noise("points on boards", cauchy=3.0, min_scale=1e-3)
FLOOR_PX = 0.02
"""px, added to every sigma: lens, board and camera are not known better than this, however many
pixels were averaged."""


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
    start: Sheets,
    data: BoundaryPoints,
    *,
    board_error_mm: float = 0.0,
    most_steps: int = MOST_STEPS,
) -> SheetFit[Sheets]:
    """Least squares on offsets of points from sheets, with Cauchy loss and the model's prior.

    board_error_mm: how well the boards' poses are known (see `BoardErrors`). It changes only the
        covariance: a board's points err together, however many they are.
    """
    _, jacobian = start.prior()
    solution = minimize(
        start,
        lambda sheets: _blocks(sheets, data),
        lambda sheets, step: sheets.retract(step),
        unknowns=jacobian.shape[1],
        steps=most_steps,
        tolerance=SETTLED,
        damping=1e-6,
    )
    sheets, points = solution.state, solution.blocks[0]
    by_point = sheets.offset(data.points, sheets.at(data.index.astype(float))).by_point
    covariance = solution.covariance
    if board_error_mm > 0.0:
        covariance = covariance + _of_boards(solution, data, by_point, board_error_mm)
    return SheetFit(
        sheets.with_covariance(0.5 * (covariance + covariance.T)),
        points.residuals / np.linalg.norm(by_point, axis=1),
        solution.weights[0],
        solution.scales[0],
    )


def _blocks(sheets: SmoothSheets, data: BoundaryPoints) -> tuple[Block, Block]:
    """Offsets of the points, over what their pixel error is worth there, and the model's prior."""
    with np.errstate(all="ignore"):
        at = sheets.at(data.index.astype(float))
        offset = sheets.offset(data.points, at, parameters=True)
    by_parameter = offset.by_parameter
    assert by_parameter is not None
    leverage = np.abs(np.einsum("ni,ni->n", offset.by_point, data.per_pixel))
    sigma = np.maximum(leverage, 1e-12) * np.hypot(data.sigma_px, FLOOR_PX)
    # Sheets that leave points behind the projector are invalid.
    value = np.where(offset.reach > 0.0, offset.value, np.nan)
    known, jacobian = sheets.prior()
    every = slice(0, jacobian.shape[1])
    return (
        Block(value, lambda: by_parameter, every, POINTS, sigma),
        Block(known, lambda: jacobian, every, EXACT),
    )


def _of_boards(
    solution: Solution[Sheets], data: BoundaryPoints, by_point: Array, board_error_mm: float
) -> Array:
    """Covariance added by each board's own pose error (a sandwich with boards as clusters)."""
    points, noise = solution.blocks[0], solution.covariance
    errors = data.board_errors
    off = np.einsum("ni,ni->n", by_point, errors.along_ray)
    weights = solution.weights[0] / (points.sigma * solution.scales[0]) ** 2
    effects = errors.effects * (off * weights)[:, None]
    total = np.zeros_like(noise)
    for board in np.unique(data.board):
        own = data.board == board
        pulled = board_error_mm * noise @ (points.jacobian[own].T @ effects[own])
        total += pulled @ pulled.T
    return total
