"""The camera of a pair: maximum likelihood over intrinsics and board poses, with covariance (3.1)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bodyscan.arrays import Array
from bodyscan.calibration.board_views import PlanarView
from bodyscan.calibration.zhang import (
    camera_from_plane,
    homography,
    matrix_from_homographies,
)
from bodyscan.errors import DegeneratePoses
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.least_squares import minimize
from bodyscan.geometry.lenses import Radial
from bodyscan.geometry.lenses.lens import Lens
from bodyscan.geometry.transforms import RigidTransform, twist_jacobian

FEWEST_POSES = 3
CHAPTERS_LENS = Radial()


@dataclass(frozen=True, eq=False)
class CameraCalibration:
    """camera with the covariance (P, P) of its parameters, and the board's pose in each shot.

    rms_px: root mean square distance of corners to their reprojection, robustly weighted.
    """

    camera: Camera
    covariance: Array
    camera_from_board: dict[str, RigidTransform]
    residuals_px: dict[str, Array]
    rms_px: float


@dataclass(frozen=True, eq=False)
class _State:
    camera: Camera
    poses: tuple[RigidTransform, ...]


def calibrate_camera(
    views: Sequence[PlanarView], width: int, height: int, lens: Lens = CHAPTERS_LENS
) -> CameraCalibration:
    """Zhang's method with skew, and with a lens of the kind of `lens`, which it starts from.

    Raises DegeneratePoses for fewer than three poses or poses that differ by a translation only.
    """
    if len(views) < FEWEST_POSES:
        raise DegeneratePoses(
            f"{len(views)} usable board poses, at least {FEWEST_POSES} are needed",
            remedy="capture the board in more poses, tilted differently, well inside the image",
        )
    homographies = [homography(view.points[:, :2], view.pixels) for view in views]
    matrix = matrix_from_homographies(homographies, width, height)
    camera = _camera(matrix, lens, width, height)
    inverse = np.linalg.inv(matrix)
    poses = tuple(
        camera_from_plane(inverse @ h, float(view.points[0, 2]))
        for h, view in zip(homographies, views, strict=True)
    )
    start = _State(camera, poses)
    solution = minimize(
        start,
        lambda state: _linearize(state, views),
        lambda state: _residuals(state, views),
        _retract,
    )
    residuals = np.split(
        solution.residuals.reshape(-1, 2), np.cumsum([len(view.pixels) for view in views])[:-1]
    )
    weights = solution.weights[::2]
    squared = np.sum(solution.residuals.reshape(-1, 2) ** 2, axis=1)
    size = len(camera.parameters)
    return CameraCalibration(
        solution.state.camera,
        solution.covariance[:size, :size],
        dict(zip((view.shot for view in views), solution.state.poses, strict=True)),
        dict(zip((view.shot for view in views), residuals, strict=True)),
        float(np.sqrt(np.sum(weights * squared) / np.sum(weights))),
    )


def locate_board(camera: Camera, view: PlanarView) -> tuple[RigidTransform, Array]:
    """`camera_from_board` of one view for a known camera, and its residuals (N, 2) px."""
    normalized = camera.rays(view.pixels)[:, :2]
    h = homography(view.points[:, :2], normalized)
    start = _State(camera, (camera_from_plane(h, float(view.points[0, 2])),))
    solution = minimize(
        start,
        lambda state: _pose_only(state, view),
        lambda state: _residuals(state, [view]),
        lambda state, step: _State(camera, (state.poses[0].moved(step),)),
        iterations=30,
    )
    return solution.state.poses[0], solution.residuals.reshape(-1, 2)


def _camera(matrix: Array, lens: Lens, width: int, height: int) -> Camera:
    return Camera(
        alpha=float(matrix[0, 0]),
        beta=float(matrix[1, 1]),
        gamma=float(matrix[0, 1]),
        u0=float(matrix[0, 2]),
        v0=float(matrix[1, 2]),
        lens=lens,
        width=width,
        height=height,
    )


def _residuals(state: _State, views: Sequence[PlanarView]) -> Array:
    parts = [
        state.camera.project(pose.apply(view.points)) - view.pixels
        for pose, view in zip(state.poses, views, strict=True)
    ]
    return np.concatenate(parts).ravel()


def _linearize(state: _State, views: Sequence[PlanarView]) -> tuple[Array, Array]:
    count, size = sum(len(view.pixels) for view in views), len(state.camera.parameters)
    jacobian = np.zeros((count, 2, size + 6 * len(views)))
    row = 0
    for k, (pose, view) in enumerate(zip(state.poses, views, strict=True)):
        points = pose.apply(view.points)
        rows = slice(row, row + len(points))
        jacobian[rows, :, :size], by_point = state.camera.jacobians(points)
        first = size + 6 * k
        jacobian[rows, :, first : first + 6] = by_point @ twist_jacobian(points)
        row += len(points)
    return _residuals(state, views), jacobian.reshape(2 * count, -1)


def _pose_only(state: _State, view: PlanarView) -> tuple[Array, Array]:
    residuals, jacobian = _linearize(state, [view])
    return residuals, jacobian[:, -6:]


def _retract(state: _State, step: Array) -> _State:
    size = len(state.camera.parameters)
    twists = step[size:].reshape(-1, 6)
    poses = tuple(pose.moved(twist) for pose, twist in zip(state.poses, twists, strict=True))
    return _State(state.camera.moved(step[:size]), poses)
