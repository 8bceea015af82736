"""Smooth sheets of light fitted to stripe boundaries on boards, with their covariance."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from bodyscan.calibration.boundary_points import BoundaryPoints, board_errors
from bodyscan.geometry.least_squares import spread
from bodyscan.geometry.smooth_sheets import Offset, SmoothSheets

Array = NDArray[np.float64]
Sheets = TypeVar("Sheets", bound=SmoothSheets)

MOST_STEPS = 25
SETTLED = 0.01
"""A step that lowers the cost by less than this (in units of its own standard deviation squared)
is the last."""
CAUCHY_SIGMAS = 3.0
BLOCK = 128
FLOOR_PX = 0.02
"""Added to every sigma: lens, board and camera are not known better than this, however many pixels
a mean was taken over."""


@dataclass(frozen=True, eq=False)
class SheetFit(Generic[Sheets]):
    """sheets with their covariance.

    distances_mm: (N,) of the points to them.  weights: (N,), robust.  noise: robust spread of the
    distances, in the points' own standard deviations.
    """

    sheets: Sheets
    distances_mm: Array
    weights: Array
    noise: float

    @property
    def rms_mm(self) -> float:
        """Robustly weighted root mean square of the distances."""
        return float(np.sqrt(np.average(self.distances_mm**2, weights=self.weights)))


@dataclass(frozen=True, eq=False)
class _Equations:
    """One linearisation: offsets over their sigma (N,), sigma (N,), noise: the offsets' own spread,
    robust weights (N,), normal matrix (P, P) and gradient (P,) of half the cost, with the prior."""

    offset: Offset
    residuals: Array
    sigma: Array
    noise: float
    weights: Array
    normal: Array
    gradient: Array


def fit_sheets(
    start: Sheets,
    data: BoundaryPoints,
    *,
    board_error_mm: float = 0.0,
    most_steps: int = MOST_STEPS,
) -> SheetFit[Sheets]:
    """Levenberg-Marquardt on the points' offsets from their sheets: Cauchy loss, the model's prior.

    board_error_mm: how well the boards' places are known (see `BoardErrors`). It does not change
    the sheets but their covariance: a board's points err together, however many they are.
    """
    sheets, damping = start, 1e-6
    equations = _equations(sheets, data)
    for _ in range(most_steps):
        cost = _cost(sheets, data, equations)
        for _ in range(8):
            step = -_solve(equations.normal, equations.gradient, damping)
            candidate = sheets.retract(step)
            drop = cost - _cost(candidate, data, equations)
            if drop > 0.0:
                break
            damping = max(10.0 * damping, 1e-4)
        else:
            break
        sheets, damping = candidate, max(damping / 10.0, 1e-9)
        equations = _equations(sheets, data)
        if drop < SETTLED:
            break
    by_point = equations.offset.by_point
    distances = equations.offset.value / np.linalg.norm(by_point, axis=1)
    covariance = _covariance(equations, data, board_error_mm)
    return SheetFit(
        sheets.with_covariance(covariance), distances, equations.weights, equations.noise
    )


def _equations(sheets: SmoothSheets, data: BoundaryPoints) -> _Equations:
    offset = sheets.offset(data.points, sheets.at(data.index.astype(float)), parameters=True)
    assert offset.by_parameter is not None
    leverage = np.abs(np.sum(offset.by_point * data.per_pixel, axis=1))
    sigma = np.maximum(leverage, 1e-12) * np.hypot(data.sigma_px, FLOOR_PX)
    residuals = offset.value / sigma
    noise = max(spread(residuals), 1e-3)
    weights = 1.0 / (1.0 + (residuals / (CAUCHY_SIGMAS * noise)) ** 2)
    weighted = offset.by_parameter * (weights / (sigma * noise) ** 2)[:, None]
    known, jacobian = sheets.prior()
    return _Equations(
        offset,
        residuals,
        sigma,
        noise,
        weights,
        _gram(weighted, offset.by_parameter) + jacobian.T @ jacobian,
        weighted.T @ offset.value + jacobian.T @ known,
    )


def _gram(left: Array, right: Array) -> Array:
    """left.T @ right for tall matrices, in blocks too small for BLAS to start threads for: pairs
    are fitted side by side, and threads that wait for a core cost several times what they save."""
    blocks = len(left) // BLOCK
    cut = blocks * BLOCK
    head, tail = (matrix[:cut].reshape(blocks, BLOCK, -1) for matrix in (left, right))
    return np.sum(head.transpose(0, 2, 1) @ tail, axis=0) + left[cut:].T @ right[cut:]


def _cost(sheets: SmoothSheets, data: BoundaryPoints, equations: _Equations) -> float:
    """Half of it is what `equations` linearises; its sigma and noise are kept."""
    with np.errstate(all="ignore"):
        offset = sheets.offset(data.points, sheets.at(data.index.astype(float)))
        scaled = offset.value / (equations.sigma * equations.noise * CAUCHY_SIGMAS)
        loss = CAUCHY_SIGMAS**2 * float(np.sum(np.log1p(scaled**2)))
    known, _ = sheets.prior()
    in_front = bool(np.all(offset.reach > 0.0))
    return loss + float(known @ known) if in_front and np.isfinite(loss) else np.inf


def _solve(normal: Array, right: Array, damping: float = 0.0) -> Array:
    """normal x = right, scaled to a unit diagonal: freedoms mix radians, mm and stripes."""
    size = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    scaled = normal / np.outer(size, size) + damping * np.eye(len(normal))
    columns = right.reshape(len(right), -1) / size[:, None]
    solved = np.linalg.lstsq(scaled, columns, rcond=1e-14)[0] / size[:, None]
    return solved.reshape(right.shape)


def _covariance(equations: _Equations, data: BoundaryPoints, board_error_mm: float) -> Array:
    """Of the noise, and of each board's error on its own (a sandwich with boards as clusters)."""
    covariance = noise = _solve(equations.normal, np.eye(len(equations.normal)))
    if board_error_mm > 0.0:
        errors = board_errors(data)
        off = np.sum(equations.offset.by_point * errors.along_ray, axis=1)
        weights = equations.weights / (equations.sigma * equations.noise) ** 2
        effects = errors.effects * (off * weights)[:, None]
        jacobian = equations.offset.by_parameter
        assert jacobian is not None
        for board in np.unique(data.board):
            own = data.board == board
            pulled = board_error_mm * noise @ (jacobian[own].T @ effects[own])
            covariance = covariance + pulled @ pulled.T
    return 0.5 * (covariance + covariance.T)
