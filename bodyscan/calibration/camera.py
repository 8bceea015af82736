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
from bodyscan.geometry.least_squares import Block, Noise, minimize
from bodyscan.geometry.lenses.lens import Lens
from bodyscan.geometry.lenses.radial import Radial
from bodyscan.geometry.transforms import RigidTransform, twist_jacobian

FEWEST_POSES = 3
CHAPTERS_LENS = Radial()
CORNERS = Noise("corners", group=2, cauchy=4.0)


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

    def moved(self, step: Array) -> _State:
        size = len(self.camera.parameters)
        twists = step[size:].reshape(-1, 6)
        poses = tuple(pose.moved(twist) for pose, twist in zip(self.poses, twists, strict=True))
        return _State(self.camera.moved(step[:size]), poses)


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
    size = len(camera.parameters)
    solution = minimize(
        _State(camera, poses),
        lambda state: [
            _corners(state.camera, pose, view, size + 6 * k)
            for k, (pose, view) in enumerate(zip(state.poses, views, strict=True))
        ],
        _State.moved,
        unknowns=size + 6 * len(views),
    )
    residuals = [block.residuals.reshape(-1, 2) for block in solution.blocks]
    weights = np.concatenate(solution.weights)[::2]
    squared = np.sum(np.concatenate(residuals) ** 2, axis=1)
    shots = [view.shot for view in views]
    return CameraCalibration(
        solution.state.camera,
        solution.variance * solution.covariance[:size, :size],
        dict(zip(shots, solution.state.poses, strict=True)),
        dict(zip(shots, residuals, strict=True)),
        float(np.sqrt(np.sum(weights * squared) / np.sum(weights))),
    )


def locate_board(camera: Camera, view: PlanarView) -> tuple[RigidTransform, Array]:
    """`camera_from_board` of one view for a known camera, and its residuals (N, 2) px."""
    # A start only: where the lens folds, the pixel without its lens has to do.
    seen = camera.rays(view.pixels)[:, :2]
    normalized = np.where(np.isfinite(seen), seen, camera.normalized_from_pixels(view.pixels))
    h = homography(view.points[:, :2], normalized)
    solution = minimize(
        camera_from_plane(h, float(view.points[0, 2])),
        lambda pose: [_corners(camera, pose, view)],
        RigidTransform.moved,
        unknowns=6,
        steps=30,
    )
    return solution.state, solution.blocks[0].residuals.reshape(-1, 2)


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


def _corners(
    camera: Camera, pose: RigidTransform, view: PlanarView, column: int | None = None
) -> Block:
    """One view's reprojection errors, px; by the camera's parameters, which come first, and by its
    board's pose from `column` on, or by the pose alone.
    """
    points = pose.apply(view.points)

    def linearize() -> Array:
        by_parameter, by_point = camera.jacobians(points)
        by_pose = by_point @ twist_jacobian(points)
        every = by_pose if column is None else np.concatenate([by_parameter, by_pose], axis=2)
        return every.reshape(-1, every.shape[2])

    own = np.arange(6) + (column or 0)
    columns = own if column is None else np.append(np.arange(len(camera.parameters)), own)
    return Block((camera.project(points) - view.pixels).ravel(), linearize, columns, CORNERS)
