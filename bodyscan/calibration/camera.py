"""The camera of a pair: maximum likelihood over intrinsics and board poses, with covariance (3.1)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bodyscan.calibration.zhang import (
    camera_from_plane,
    homography,
    matrix_from_homographies,
)
from bodyscan.errors import DegeneratePoses
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.least_squares import minimize
from bodyscan.geometry.transforms import RigidTransform, twist_jacobian

Array = NDArray[np.float64]

INTRINSICS = ("alpha", "beta", "gamma", "u0", "v0", "k1", "k2")
FEWEST_POSES = 3


@dataclass(frozen=True, eq=False)
class PlanarView:
    """One board in one image: points (N, 3) of its frame, all at one z, and pixels (N, 2)."""

    shot: str
    points: Array
    pixels: Array


@dataclass(frozen=True, eq=False)
class CameraCalibration:
    """camera with its covariance (7, 7) over INTRINSICS, and the board's pose in each shot.

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


def calibrate_camera(views: Sequence[PlanarView], width: int, height: int) -> CameraCalibration:
    """Zhang's method with skew, k1 and k2.

    Raises DegeneratePoses for fewer than three poses or poses that differ by a translation only.
    """
    if len(views) < FEWEST_POSES:
        raise DegeneratePoses(
            f"{len(views)} usable board poses, at least {FEWEST_POSES} are needed",
            remedy="capture the board in more poses, tilted differently, well inside the image",
        )
    homographies = [homography(view.points[:, :2], view.pixels) for view in views]
    matrix = matrix_from_homographies(homographies, width, height)
    camera = _camera(matrix, width, height)
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
    return CameraCalibration(
        solution.state.camera,
        solution.covariance[:7, :7],
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
        lambda state: _pose_only(_linearize(state, [view])),
        lambda state: _residuals(state, [view]),
        lambda state, step: _State(camera, (state.poses[0].moved(step),)),
        iterations=30,
    )
    return solution.state.poses[0], solution.residuals.reshape(-1, 2)


def projection_jacobians(camera: Camera, points: Array) -> tuple[Array, Array]:
    """d(pixels)/d(intrinsics) (N, 2, 7) and d(pixels)/d(points) (N, 2, 3), points (N, 3) mm."""
    z = points[:, 2]
    x, y = points[:, 0] / z, points[:, 1] / z
    r2 = x * x + y * y
    factor = 1.0 + r2 * (camera.k1 + r2 * camera.k2)
    slope = 2.0 * (camera.k1 + 2.0 * r2 * camera.k2)
    xd, yd = x * factor, y * factor
    a = camera.matrix[:2, :2]
    intrinsics = np.zeros((len(points), 2, 7))
    intrinsics[:, 0, 0], intrinsics[:, 1, 1], intrinsics[:, 0, 2] = xd, yd, yd
    intrinsics[:, 0, 3] = intrinsics[:, 1, 4] = 1.0
    radial = np.stack([x, y], axis=1) @ a.T
    intrinsics[:, :, 5], intrinsics[:, :, 6] = radial * r2[:, None], radial * r2[:, None] ** 2
    distortion = np.empty((len(points), 2, 2))
    distortion[:, 0, 0], distortion[:, 1, 1] = factor + slope * x * x, factor + slope * y * y
    distortion[:, 0, 1] = distortion[:, 1, 0] = slope * x * y
    perspective = np.zeros((len(points), 2, 3))
    perspective[:, 0, 0] = perspective[:, 1, 1] = 1.0 / z
    perspective[:, 0, 2], perspective[:, 1, 2] = -x / z, -y / z
    return intrinsics, a @ distortion @ perspective


def _camera(matrix: Array, width: int, height: int) -> Camera:
    return Camera(
        alpha=float(matrix[0, 0]),
        beta=float(matrix[1, 1]),
        gamma=float(matrix[0, 1]),
        u0=float(matrix[0, 2]),
        v0=float(matrix[1, 2]),
        k1=0.0,
        k2=0.0,
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
    count = sum(len(view.pixels) for view in views)
    jacobian = np.zeros((count, 2, 7 + 6 * len(views)))
    row = 0
    for k, (pose, view) in enumerate(zip(state.poses, views, strict=True)):
        points = pose.apply(view.points)
        rows = slice(row, row + len(points))
        intrinsics, by_point = projection_jacobians(state.camera, points)
        jacobian[rows, :, :7] = intrinsics
        jacobian[rows, :, 7 + 6 * k : 13 + 6 * k] = by_point @ twist_jacobian(points)
        row += len(points)
    return _residuals(state, views), jacobian.reshape(2 * count, -1)


def _pose_only(linearized: tuple[Array, Array]) -> tuple[Array, Array]:
    residuals, jacobian = linearized
    return residuals, jacobian[:, 7:]


def _retract(state: _State, step: Array) -> _State:
    changed = {
        name: getattr(state.camera, name) + float(change)
        for name, change in zip(INTRINSICS, step[:7], strict=True)
    }
    poses = tuple(
        pose.moved(twist) for pose, twist in zip(state.poses, step[7:].reshape(-1, 6), strict=True)
    )
    return _State(replace(state.camera, **changed), poses)
