"""Calibrate a camera and its board poses by maximum likelihood, with covariance (3.1)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from bodyscan.arrays import Array, Indices
from bodyscan.calibration.board_views import PlanarView
from bodyscan.calibration.zhang import matrix_from_homographies
from bodyscan.errors import DegeneratePoses
from bodyscan.geometry.camera import MATRIX, Camera
from bodyscan.geometry.least_squares import EXACT, Block, Noise, Solution, minimize
from bodyscan.geometry.lenses.lens import Lens
from bodyscan.geometry.lenses.opencv import Radial
from bodyscan.geometry.transforms import RigidTransform, twist_jacobian

MIN_POSES = 3
CHAPTER_LENS = Radial()
CORNERS = Noise("corners", group=2, cauchy=4.0)


@dataclass(frozen=True, eq=False)
class CameraCalibration:
    """A calibrated camera."""

    camera: Camera
    covariance: Array  # of the camera's parameters, (P, P)
    poses: tuple[RigidTransform, ...]  # `camera_from_board` of each view that it was fitted to
    rms_px: float  # RMS distance of corners from their reprojection, robustly weighted


@dataclass(frozen=True, eq=False)
class _State:
    camera: Camera
    poses: tuple[RigidTransform, ...]

    def retract(self, step: Array) -> _State:
        size = len(self.camera.parameters)
        return _State(self.camera.retract(step[:size]), self.retract_poses(step[size:]).poses)

    def retract_poses(self, step: Array) -> _State:
        twists = zip(self.poses, step.reshape(-1, 6), strict=True)
        return _State(self.camera, tuple(pose.retract(twist) for pose, twist in twists))


def calibrate_camera(
    views: Sequence[PlanarView], width: int, height: int, lens: Lens = CHAPTER_LENS
) -> CameraCalibration:
    """Calibrate a camera from planes, with skew and a lens of the kind of `lens`, the start.

    Started by Zhang's closed form. Raises DegeneratePoses for fewer than three poses, or poses that
    differ only by a translation.
    """
    if len(views) < MIN_POSES:
        raise DegeneratePoses(
            f"{len(views)} usable board poses, at least {MIN_POSES} are needed",
            remedy="capture the board in more poses, tilted differently, well inside the image",
        )
    homographies = [cv2.findHomography(v.points[:, :2], v.pixels, 0)[0] for v in views]
    _refuse_parallel(homographies, width, height)
    matrix = matrix_from_homographies(homographies, width, height)
    alpha, gamma, u0, _, beta, v0 = matrix[:2].ravel()
    start = Camera(alpha, beta, gamma, u0, v0, type(lens)(), width, height)
    poses = [estimate_pose(start, view) for view in views]
    return fit_camera(replace(start, lens=lens), poses, views)


def _refuse_parallel(homographies: Sequence[Array], width: int, height: int) -> None:
    """Raise DegeneratePoses if all boards have one orientation (pure translation, Zhang 1998). Parallel
    planes share their vanishing line, which a rough camera turns into a plane normal."""
    rough = np.array([[1.2 * width, 0, width / 2], [0, 1.2 * width, height / 2], [0, 0, 1.0]])
    normals = np.stack([np.linalg.inv(h).T[:, 2] for h in homographies]) @ rough
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    angles = np.degrees(np.arccos(np.clip(np.abs(normals @ normals.T), 0.0, 1.0)))
    if np.max(angles) < 3.0:
        raise DegeneratePoses(
            f"the {len(homographies)} board poses differ by a translation only "
            f"(their orientations agree within {np.max(angles):.1f} degrees)",
            remedy="tilt the board by 15 to 35 degrees about different axes between the shots",
        )


def calibrate_known_camera(views: Sequence[PlanarView], camera: Camera) -> CameraCalibration:
    """Refine a camera with a prior on its views, within that prior; one view is enough.

    Raises DegeneratePoses if there is no view.
    """
    if not views:
        raise DegeneratePoses(
            "no board view of a camera that is known has enough corners",
            remedy="show it the board in a shot that others see too",
        )
    return fit_camera(camera, [locate_board(camera, view)[0] for view in views], views)


def fit_camera(
    camera: Camera, poses: Sequence[RigidTransform], views: Sequence[PlanarView]
) -> CameraCalibration:
    """Fit camera and `camera_from_board` of each view by least squares, starting from those given."""
    solution = minimize_camera(camera, poses, views)
    size, corners = len(camera.parameters), solution.blocks[0]
    return CameraCalibration(
        solution.state.camera,
        solution.variance * solution.covariance[:size, :size],
        solution.state.poses,
        compute_weighted_rms(corners.residuals.reshape(-1, 2), solution.weights[0][::2]),
    )


def minimize_camera(
    camera: Camera,
    poses: Sequence[RigidTransform],
    views: Sequence[PlanarView],
    *,
    tolerance: float = 1e-6,
    damping: float = 1e-3,
) -> Solution[_State]:
    """Minimise the corners' reprojection errors over camera and poses; see `minimize`."""
    size = len(camera.parameters)
    return minimize(
        _State(camera, tuple(poses)),
        lambda state: [
            _make_corner_block(state, views),
            evaluate_camera_prior(state.camera, np.arange(size)),
        ],
        _State.retract,
        unknowns=size + 6 * len(views),
        tolerance=tolerance,
        damping=damping,
    )


def compute_corner_residuals(fit: CameraCalibration, views: Sequence[PlanarView]) -> Array:
    """Compute the reprojection errors (N, 2) px of all corners of the views that were fitted."""
    return _make_corner_block(_State(fit.camera, fit.poses), views).residuals.reshape(-1, 2)


def compute_weighted_rms(residuals: Array, weights: Array) -> float:
    """Compute the weighted RMS length of residuals (N, 2)."""
    return float(np.sqrt(np.sum(weights * np.sum(residuals**2, axis=1)) / np.sum(weights)))


def evaluate_camera_prior(camera: Camera, columns: Indices) -> Block:
    """Residuals of the prior of a camera: the one it has, otherwise that its lens distorts little.

    The latter keeps coefficients that the boards do not determine, or only their sum, from growing
    without limit. columns: indices of the camera's parameters among the unknowns.
    """
    if camera.prior is None:
        weights = 1.0 / camera.lens.prior_sigmas
        residuals = weights * camera.lens.coefficients
        return Block(residuals, lambda: np.diag(weights), columns[len(MATRIX) :], EXACT)
    weights = 1.0 / camera.prior.sigmas
    residuals = weights * (camera.parameters - camera.prior.parameters)
    return Block(residuals, lambda: np.diag(weights), columns, EXACT)


def locate_board(camera: Camera, view: PlanarView) -> tuple[RigidTransform, Array]:
    """Fit `camera_from_board` of one view with a known camera; also return residuals (N, 2) px."""
    (pose,), (residuals,) = locate_boards(camera, [view], [estimate_pose(camera, view)])
    return pose, residuals


def estimate_pose(camera: Camera, view: PlanarView) -> RigidTransform:
    """Estimate `camera_from_board` of one view in closed form: a start for `locate_boards`.

    Source: Terzakis and Lourakis, A Consistently Fast and Globally Optimal Solution to the
    Perspective-n-Point Problem, ECCV 2020 (OpenCV's).
    """
    # Where the lens folds there is no ray: use the pixel with the lens ignored.
    rays = camera.rays(view.pixels)[:, :2]
    normalized = np.where(np.isfinite(rays), rays, camera.normalized_from_pixels(view.pixels))
    flags = cv2.SOLVEPNP_SQPNP
    _, turn, shift = cv2.solvePnP(view.points, normalized, np.eye(3), None, flags=flags)
    return RigidTransform.from_rotation_vector(turn, shift.ravel())


def locate_boards(
    camera: Camera,
    views: Sequence[PlanarView],
    starts: Sequence[RigidTransform],
    *,
    tolerance: float = 1e-6,
) -> tuple[tuple[RigidTransform, ...], tuple[Array, ...]]:
    """Fit `camera_from_board` of each view with a known camera; also return residuals (N, 2) px.

    All corners share one noise level.
    """
    solution = minimize(
        _State(camera, tuple(starts)),
        lambda state: [_make_corner_block(state, views, camera_free=False)],
        _State.retract_poses,
        unknowns=6 * len(views),
        steps=30,
        tolerance=tolerance,
    )
    ends = np.cumsum([len(view.points) for view in views])[:-1]
    residuals = solution.blocks[0].residuals.reshape(-1, 2)
    return solution.state.poses, tuple(np.split(residuals, ends))


def _make_corner_block(
    state: _State, views: Sequence[PlanarView], *, camera_free: bool = True
) -> Block:
    """Reprojection errors, px, one run for each view. Derivatives are by the camera's parameters, which
    come first if free, and by the board's pose."""
    points = np.concatenate(
        [pose.apply(view.points) for pose, view in zip(state.poses, views, strict=True)]
    )
    pixels = np.concatenate([view.pixels for view in views])
    camera = state.camera
    size = len(camera.parameters) if camera_free else 0
    boards = size + np.arange(6 * len(views)).reshape(-1, 6)

    def linearize() -> Array:
        by_parameter, by_point = camera.jacobians(points)
        by_pose = by_point @ twist_jacobian(points)
        return np.concatenate([by_parameter[..., :size], by_pose], axis=2).reshape(-1, size + 6)

    return Block(
        (camera.project(points) - pixels).ravel(),
        linearize,
        np.column_stack([np.tile(np.arange(size), (len(views), 1)), boards]),
        CORNERS,
        runs=np.array([2 * len(view.points) for view in views]),
    )
