"""Camera, board poses and light sheets of one pair in one solve, on corners and stripes together.

Stripes are straight-edged light on a flat board: they say how boards lie to each other far more
finely than 48 corners do, and corners keep the scale.  Only for sheets that are smooth in s, whose few
parameters are unknowns like any other.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Generic, TypeVar

import numpy as np

from bodyscan.arrays import Array
from bodyscan.calibration.board_views import PlanarView
from bodyscan.calibration.boundary_points import BoundaryPoints, rays_on_board
from bodyscan.calibration.camera import known_beforehand
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.least_squares import EXACT, Block, Noise, minimize
from bodyscan.geometry.smooth_sheets import SmoothSheets
from bodyscan.geometry.transforms import RigidTransform, twist_jacobian

Sheets = TypeVar("Sheets", bound=SmoothSheets)

STEPS = 20
SETTLED = 1e-2
"""Variances: all unknowns a tenth of their standard deviation away would be as good."""
CORNERS = Noise("corners, px", group=2, cauchy=4.0, least=1e-3)
STRIPES = Noise("stripes, in sigmas", cauchy=4.0, least=1e-2)
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
    """Least squares from a camera, poses and sheets found one after the other.

    Boards of which only corners are known take part with empty pixels.
    """
    start = _State(camera, tuple(camera_from_board[b.view.shot] for b in boards), sheets)
    first, last = start.first_pose, start.first_sheet
    unknowns = last + sheets.prior()[1].shape[1]
    solution = minimize(
        start,
        lambda state: _blocks(state, boards, unknowns),
        lambda state, step: state.moved(step),
        unknowns=unknowns,
        steps=STEPS,
        settled=SETTLED,
        damping=1e-6,
    )
    state, covariance = solution.state, solution.covariance
    corners = np.concatenate([_corner_residuals(state, k, b) for k, b in enumerate(boards)])
    offsets = [
        _offsets(state.sheets, pose, b, _rays(state.camera, b)) * b.sigma_px
        for pose, b in zip(state.poses, boards, strict=True)
    ]
    return JointFit(
        state.camera,
        {b.view.shot: pose for b, pose in zip(boards, state.poses, strict=True)},
        state.sheets.with_covariance(covariance[last:, last:]),
        covariance[:first, :first],
        _weighted_rms(corners, CORNERS) * np.sqrt(2.0),
        _weighted_rms(np.concatenate(offsets), STRIPES),
    )


def _blocks(
    state: _State[Sheets], boards: Sequence[StripedBoard], unknowns: int
) -> Iterator[Block]:
    """Of each board its corners and its stripes; last what is known of camera and sheets
    beforehand."""
    camera, sheets = np.arange(state.first_pose), np.arange(state.first_sheet, unknowns)
    with np.errstate(all="ignore"):
        for k, board in enumerate(boards):
            pose = state.first_pose + 6 * k + np.arange(6)
            corners, rays = _corner_residuals(state, k, board), _rays(state.camera, board)
            stripes = _offsets(state.sheets, state.poses[k], board, rays)
            of_corners = partial(_corner_jacobian, state, k, board)
            of_stripes = partial(_stripe_jacobian, state, k, board, rays)
            yield Block(corners, of_corners, np.concatenate([camera, pose]), CORNERS)
            yield Block(stripes, of_stripes, np.concatenate([camera, pose, sheets]), STRIPES)
    if state.camera.prior is not None:
        yield known_beforehand(state.camera, camera)
    known, jacobian = state.sheets.prior()
    yield Block(known, lambda: jacobian, sheets, EXACT)


def _corner_residuals(state: _State[Sheets], k: int, board: StripedBoard) -> Array:
    seen = state.camera.project(state.poses[k].apply(board.view.points))
    return (seen - board.view.pixels).ravel()


def _rays(camera: Camera, board: StripedBoard) -> Array:
    """(2, N, 3) with z = 1: through the boundaries' pixels, and half a pixel across from them."""
    return camera.rays(np.stack([board.pixels, board.pixels + 0.5 * board.across]))


def _ray_slopes(camera: Camera, rays: Array) -> Array:
    """(2, N, 2, P): how rays turn with the camera's parameters while their pixels stay, which undoes
    what the parameters do to the pixels of rays that stay."""
    by_parameter, by_point = camera.jacobians(rays.reshape(-1, 3))
    (a, b), (c, d) = by_point[:, :, :2].transpose(1, 2, 0)
    inverse = np.stack([d, -b, -c, a], axis=-1).reshape(-1, 2, 2) / (a * d - b * c)[:, None, None]
    return -(inverse @ by_parameter).reshape(*rays.shape[:2], 2, -1)


def _offsets(
    sheets: Sheets, camera_from_board: RigidTransform, board: StripedBoard, rays: Array
) -> Array:
    """Offsets of one board's boundaries from their sheets, over their sigma, (N,); rays: `_rays`."""
    points, across = _on_board(camera_from_board, board, rays)
    offset = sheets.offset(points, sheets.at(board.index))
    return np.asarray(offset.value / _sigma(board, points, across, offset.by_point), np.float64)


def _on_board(camera_from_board: RigidTransform, board: StripedBoard, rays: Array) -> Array:
    """(2, N, 3) mm: where rays meet the face on which the stripes were seen."""
    height = RigidTransform(np.eye(3), np.array([0.0, 0.0, board.view.points[0, 2]]))
    return rays_on_board(rays, camera_from_board @ height)


def _sigma(board: StripedBoard, points: Array, across: Array, by_point: Array) -> Array:
    """What one sigma_px across the stripe is worth in the offset's unit, (N,)."""
    leverage = np.abs(np.sum(by_point * (across - points), axis=1)) / 0.5
    return np.maximum(leverage, 1e-12) * board.sigma_px


def _corner_jacobian(state: _State[Sheets], k: int, board: StripedBoard) -> Array:
    points = state.poses[k].apply(board.view.points)
    by_parameter, by_point = state.camera.jacobians(points)
    jacobian = np.concatenate([by_parameter, by_point @ twist_jacobian(points)], axis=2)
    return jacobian.reshape(-1, jacobian.shape[2])


def _stripe_jacobian(state: _State[Sheets], k: int, board: StripedBoard, rays: Array) -> Array:
    """Of the offsets over their sigma (N, ...), by camera, this board's pose, and sheets.

    By differences for camera and pose, since the sigma changes too: left out of the derivative, noise
    would pull the focal lengths up.
    """
    pose, slopes = state.poses[k], _ray_slopes(state.camera, rays)
    points, across = _on_board(pose, board, rays)
    offset = state.sheets.offset(points, state.sheets.at(board.index), parameters=True)
    assert offset.by_parameter is not None
    sigma = _sigma(board, points, across, offset.by_point)

    def turned(column: int, step: float) -> Array:
        turn = np.zeros_like(rays)
        turn[..., :2] = step * slopes[..., column]
        return _offsets(state.sheets, pose, board, rays + turn)

    def moved(column: int, step: float) -> Array:
        return _offsets(state.sheets, pose.moved(step * np.eye(6)[column]), board, rays)

    by_place = [
        (change(column, size) - change(column, -size)) / (2.0 * size)
        for change, sizes in ((turned, state.camera.difference_steps), (moved, TWIST_STEPS))
        for column, size in enumerate(sizes)
    ]
    return np.column_stack([*by_place, offset.by_parameter / sigma[:, None]])


def _weighted_rms(residuals: Array, noise: Noise) -> float:
    weights = noise.weights(residuals / noise.spread_of(residuals))
    return float(np.sqrt(np.sum(weights * residuals**2) / np.sum(weights)))
