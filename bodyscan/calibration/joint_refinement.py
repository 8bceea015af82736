"""Camera, board poses and light sheets of one pair in one solve, on corners and stripes together.

Stripes are straight-edged light on a flat board: they say how boards lie to each other far more
finely than 48 corners do, and corners keep the scale.  Only for sheets that are smooth in s, whose few
parameters are unknowns like any other.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from bodyscan.calibration.board_views import PlanarView
from bodyscan.calibration.boundary_points import BoundaryPoints, points_on_board
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.least_squares import cauchy_weights, spread
from bodyscan.geometry.smooth_sheets import SmoothSheets
from bodyscan.geometry.transforms import RigidTransform, twist_jacobian

Array = NDArray[np.float64]
Sheets = TypeVar("Sheets", bound=SmoothSheets)

STEPS = 20
CAUCHY_SIGMAS = 4.0
FLOOR_PX = 0.02
TWIST_STEPS = (*[1e-6] * 3, *[1e-3] * 3)
"""Radians and mm, for derivatives of a boundary point by its board's motion."""


@dataclass(frozen=True, eq=False)
class StripedBoard:
    """One shot: its corners, and the stripe boundaries on it: pixels (N, 2), index (N,) with s = i,
    sigma_px (N,) and across (2,), the unit vector across the stripes in the image.
    """

    view: PlanarView
    pixels: Array
    index: Array
    sigma_px: Array
    across: Array


@dataclass(frozen=True, eq=False)
class JointFit(Generic[Sheets]):
    """What fits corners and stripes together; covariance (P, P) of the camera.

    corners_rms_px and stripes_rms_px are robustly weighted.
    """

    camera: Camera
    camera_from_board: dict[str, RigidTransform]
    sheets: Sheets
    camera_covariance: Array
    corners_rms_px: float
    stripes_rms_px: float


@dataclass(frozen=True, eq=False)
class _State(Generic[Sheets]):
    camera: Camera
    poses: tuple[RigidTransform, ...]
    sheets: Sheets

    @property
    def first_pose(self) -> int:
        """Where the poses begin among the unknowns; before them the camera's parameters."""
        return len(self.camera.parameters)

    @property
    def first_sheet(self) -> int:
        return self.first_pose + 6 * len(self.poses)

    def moved(self, step: Array) -> _State[Sheets]:
        twists = step[self.first_pose : self.first_sheet].reshape(-1, 6)
        poses = tuple(p.moved(twist) for p, twist in zip(self.poses, twists, strict=True))
        camera = self.camera.moved(step[: self.first_pose])
        return _State(camera, poses, self.sheets.retract(step[self.first_sheet :]))


@dataclass(frozen=True, eq=False)
class _Noise:
    corner_px: float
    stripe: float


def striped_board(
    view: PlanarView, camera: Camera, data: BoundaryPoints, number: int
) -> StripedBoard:
    """The (binned) boundary points of one board as image measurements again."""
    own = data.board == number
    across = np.median(
        camera.project(data.points[own] + data.per_pixel[own]) - camera.project(data.points[own]),
        axis=0,
    )
    return StripedBoard(
        view,
        camera.project(data.points[own]),
        data.index[own].astype(float),
        np.hypot(data.sigma_px[own], FLOOR_PX),
        across / np.linalg.norm(across),
    )


def refine_jointly(
    camera: Camera,
    camera_from_board: Mapping[str, RigidTransform],
    sheets: Sheets,
    boards: Sequence[StripedBoard],
) -> JointFit[Sheets]:
    """Levenberg-Marquardt from a camera, poses and sheets found one after the other.

    Boards of which only corners are known take part with empty pixels.
    """
    state = _State(camera, tuple(camera_from_board[b.view.shot] for b in boards), sheets)
    noise = _noise(state, boards)
    damping, cost = 1e-6, _cost(state, boards, noise)
    for _ in range(STEPS):
        normal, gradient = _equations(state, boards, noise)
        for _ in range(8):
            candidate = state.moved(-_solve(normal, gradient, damping))
            new_cost = _cost(candidate, boards, noise)
            if new_cost < cost:
                break
            damping = max(10.0 * damping, 1e-6)
        else:
            break
        gained, state, damping = cost - new_cost, candidate, max(damping / 10.0, 1e-10)
        noise = _noise(state, boards)
        cost = _cost(state, boards, noise)
        if gained < 1e-2:
            break
    normal, _ = _equations(state, boards, noise)
    covariance = _solve(normal, np.eye(len(normal)))
    first, last = state.first_pose, state.first_sheet
    corners = np.concatenate([_corner_residuals(state, k, b) for k, b in enumerate(boards)])
    return JointFit(
        state.camera,
        {b.view.shot: pose for b, pose in zip(boards, state.poses, strict=True)},
        state.sheets.with_covariance(covariance[last:, last:]),
        covariance[:first, :first],
        _weighted_rms(corners, 2) * np.sqrt(2.0),
        _weighted_rms(np.concatenate(_stripe_residuals(state, boards, pixels=True)), 1),
    )


def _corner_residuals(state: _State[Sheets], k: int, board: StripedBoard) -> Array:
    seen = state.camera.project(state.poses[k].apply(board.view.points))
    return (seen - board.view.pixels).ravel()


def _points(state: _State[Sheets], k: int, board: StripedBoard) -> Array:
    return _on_board(state.camera, state.poses[k], board)


def _on_board(camera: Camera, camera_from_board: RigidTransform, board: StripedBoard) -> Array:
    height = RigidTransform(np.eye(3), np.array([0.0, 0.0, board.view.points[0, 2]]))
    return points_on_board(camera, camera_from_board @ height, board.pixels)


def _stripe_residuals(
    state: _State[Sheets], boards: Sequence[StripedBoard], *, pixels: bool = False
) -> list[Array]:
    """Offsets from the sheets over their sigma (or in px), board by board."""
    found = []
    for k, board in enumerate(boards):
        points = _points(state, k, board)
        offset = state.sheets.offset(points, state.sheets.at(board.index))
        sigma = _sigma(state, k, board, points, offset.by_point)
        found.append(offset.value / sigma * (board.sigma_px if pixels else 1.0))
    return found


def _sigma(
    state: _State[Sheets], k: int, board: StripedBoard, points: Array, by_point: Array
) -> Array:
    """What one sigma_px across the stripe is worth in the offset's unit, (N,)."""
    shifted = _points(state, k, replace(board, pixels=board.pixels + 0.5 * board.across))
    leverage = np.abs(np.sum(by_point * (shifted - points), axis=1)) / 0.5
    return np.maximum(leverage, 1e-12) * board.sigma_px


def _noise(state: _State[Sheets], boards: Sequence[StripedBoard]) -> _Noise:
    corners = np.concatenate([_corner_residuals(state, k, b) for k, b in enumerate(boards)])
    stripes = np.concatenate(_stripe_residuals(state, boards))
    return _Noise(max(spread(corners), 1e-3), max(spread(stripes), 1e-2))


def _cost(state: _State[Sheets], boards: Sequence[StripedBoard], noise: _Noise) -> float:
    with np.errstate(all="ignore"):
        corners = np.concatenate([_corner_residuals(state, k, b) for k, b in enumerate(boards)])
        stripes = np.concatenate(_stripe_residuals(state, boards))
        total = 0.0
        for residuals, group, size in ((corners, 2, noise.corner_px), (stripes, 1, noise.stripe)):
            squared = np.sum((residuals.reshape(-1, group) / (size * CAUCHY_SIGMAS)) ** 2, axis=1)
            total += CAUCHY_SIGMAS**2 * float(np.sum(np.log1p(squared)))
    known, _ = state.sheets.prior()
    total += float(known @ known)
    return total if np.isfinite(total) else np.inf


def _equations(
    state: _State[Sheets], boards: Sequence[StripedBoard], noise: _Noise
) -> tuple[Array, Array]:
    """Normal matrix and gradient of half the cost: camera, poses, then the sheets' parameters."""
    known, prior = state.sheets.prior()
    first, last = state.first_pose, state.first_sheet
    size = last + prior.shape[1]
    normal, gradient = np.zeros((size, size)), np.zeros(size)
    normal[last:, last:] = prior.T @ prior
    gradient[last:] = prior.T @ known
    for k, board in enumerate(boards):
        pose = first + 6 * k + np.arange(6)
        points = state.poses[k].apply(board.view.points)
        by_parameter, by_point = state.camera.jacobians(points)
        jacobian = np.concatenate([by_parameter, by_point @ twist_jacobian(points)], axis=2)
        residuals = _corner_residuals(state, k, board) / noise.corner_px
        columns = np.concatenate([np.arange(first), pose])
        rows = jacobian.reshape(-1, jacobian.shape[2]) / noise.corner_px
        _add(normal, gradient, columns, rows, residuals, 2)
        if len(board.index):
            columns = np.concatenate([np.arange(first), pose, np.arange(last, size)])
            residuals, rows = _stripe_equations(state, k, board, noise)
            _add(normal, gradient, columns, rows, residuals, 1)
    return normal, gradient


def _stripe_equations(
    state: _State[Sheets], k: int, board: StripedBoard, noise: _Noise
) -> tuple[Array, Array]:
    """Residuals (N,) and their derivatives (N, ...) by camera, this board's pose, and sheets."""
    points = _points(state, k, board)
    offset = state.sheets.offset(points, state.sheets.at(board.index), parameters=True)
    assert offset.by_parameter is not None
    sigma = _sigma(state, k, board, points, offset.by_point) * noise.stripe
    steps = np.array([*state.camera.difference_steps, *TWIST_STEPS])
    by_place = np.empty((len(points), len(steps)))
    for column, size in enumerate(steps):
        ahead, behind = (_nudged(state, k, board, column, step) for step in (size, -size))
        by_place[:, column] = (ahead - behind) / (2.0 * size * noise.stripe)
    by_parameter = offset.by_parameter / sigma[:, None]
    return offset.value / sigma, np.concatenate([by_place, by_parameter], axis=1)


def _nudged(state: _State[Sheets], k: int, board: StripedBoard, column: int, step: float) -> Array:
    """Offsets over their sigma after a step of one of the camera's parameters, or of the board's
    pose, whose columns follow.

    The sigma changes too: left out of the derivative, noise would pull the focal lengths up.
    """
    change = np.zeros(state.first_pose + 6)
    change[column] = step
    camera = state.camera.moved(change[: state.first_pose])
    pose = state.poses[k].moved(change[state.first_pose :])
    poses = (*state.poses[:k], pose, *state.poses[k + 1 :])
    return _offsets(replace(state, camera=camera, poses=poses), k, board)


def _offsets(state: _State[Sheets], k: int, board: StripedBoard) -> Array:
    """Offsets of one board's boundaries from their sheets, over their sigma, (N,)."""
    points = _points(state, k, board)
    offset = state.sheets.offset(points, state.sheets.at(board.index))
    return np.asarray(offset.value / _sigma(state, k, board, points, offset.by_point), np.float64)


def _add(
    normal: Array,
    gradient: Array,
    columns: NDArray[np.int64],
    rows: Array,
    residuals: Array,
    group: int,
) -> None:
    weights = cauchy_weights(residuals, group, CAUCHY_SIGMAS)
    normal[np.ix_(columns, columns)] += rows.T @ (rows * weights[:, None])
    gradient[columns] += rows.T @ (weights * residuals)


def _solve(normal: Array, right: Array, damping: float = 0.0) -> Array:
    """normal x = right, scaled to a unit diagonal: freedoms mix radians, mm and px."""
    size = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    scaled = normal / np.outer(size, size) + damping * np.eye(len(normal))
    columns = right.reshape(len(right), -1) / size[:, None]
    solved = np.linalg.lstsq(scaled, columns, rcond=1e-14)[0] / size[:, None]
    return np.asarray(solved.reshape(right.shape), np.float64)


def _weighted_rms(residuals: Array, group: int) -> float:
    weights = cauchy_weights(residuals, group, CAUCHY_SIGMAS * spread(residuals))
    return float(np.sqrt(np.sum(weights * residuals**2) / np.sum(weights)))
