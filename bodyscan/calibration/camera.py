"""Calibrate a camera and its board poses by maximum likelihood, with covariance (3.1)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bodyscan.arrays import Array, Indices
from bodyscan.calibration.board_views import PlanarView
from bodyscan.calibration.zhang import camera_from_plane, homography, matrix_from_homographies
from bodyscan.errors import DegeneratePoses
from bodyscan.geometry.camera import MATRIX, Camera
from bodyscan.geometry.least_squares import EXACT, Block, Noise, Solution, minimize
from bodyscan.geometry.lenses.lens import Lens
from bodyscan.geometry.lenses.opencv import Radial
from bodyscan.geometry.transforms import RigidTransform, twist_jacobian
from bodyscan.geometry.uncertainty import RayUncertainty

MIN_POSES = 3
CHAPTER_LENS = Radial()
CORNERS = Noise("corners", group=2, cauchy=4.0)


@dataclass(frozen=True)
class LensTrial:
    """How one kind of lens did on held-out boards.

    rms_px: RMS error of their corners, px, robustly weighted.
    gain: standard errors by which it beat the lens chosen so far; None for the first.
    """

    kind: str
    rms_px: float
    gain: float | None = None
    chosen: bool = False


@dataclass(frozen=True, eq=False)
class CameraCalibration:
    """A calibrated camera.

    covariance: of the camera's parameters, (P, P).
    poses: `camera_from_board` of each view that it was fitted to.
    rms_px: RMS distance of corners from their reprojection, robustly weighted.
    lenses: lenses tried on held-out boards; empty if the lens was given.
    rays: how well each pixel's ray is known; None if that was not computed.
    """

    camera: Camera
    covariance: Array
    poses: tuple[RigidTransform, ...]
    rms_px: float
    lenses: tuple[LensTrial, ...] = ()
    rays: RayUncertainty | None = None


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
    """Calibrate a camera by Zhang's method, with skew and a lens of the kind of `lens`, the start.

    Raises DegeneratePoses for fewer than three poses, or poses that differ only by a translation.
    """
    if len(views) < MIN_POSES:
        raise DegeneratePoses(
            f"{len(views)} usable board poses, at least {MIN_POSES} are needed",
            remedy="capture the board in more poses, tilted differently, well inside the image",
        )
    homographies = [homography(view.points[:, :2], view.pixels) for view in views]
    matrix = matrix_from_homographies(homographies, width, height)
    alpha, gamma, u0, _, beta, v0 = matrix[:2].ravel().tolist()
    inverse = np.linalg.inv(matrix)
    poses = [
        camera_from_plane(inverse @ h, float(view.points[0, 2]))
        for h, view in zip(homographies, views, strict=True)
    ]
    return fit_camera(Camera(alpha, beta, gamma, u0, v0, lens, width, height), poses, views)


def calibrate_known_camera(views: Sequence[PlanarView], camera: Camera) -> CameraCalibration:
    """Refine a camera with a prior on its views, within that prior; one view is enough.

    Raises DegeneratePoses if there is no view.
    """
    if not views:
        raise DegeneratePoses(
            "no board view of a camera that is known has enough corners",
            remedy="show it the board in a shot that others see too",
        )
    poses = [locate_board(camera, view)[0] for view in views]
    return fit_camera(camera, poses, views)


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
        weighted_rms(corners.residuals.reshape(-1, 2), solution.weights[0][::2]),
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
        lambda state: [_corner_block(state, views), camera_prior(state.camera, np.arange(size))],
        _State.retract,
        unknowns=size + 6 * len(views),
        tolerance=tolerance,
        damping=damping,
    )


def weighted_rms(residuals: Array, weights: Array) -> float:
    """Compute the weighted RMS length of residuals (N, 2)."""
    return float(np.sqrt(np.sum(weights * np.sum(residuals**2, axis=1)) / np.sum(weights)))


def camera_prior(camera: Camera, columns: Indices) -> Block:
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


def locate_board(
    camera: Camera, view: PlanarView, start: RigidTransform | None = None
) -> tuple[RigidTransform, Array]:
    """Fit `camera_from_board` of one view with a known camera; also return residuals (N, 2) px."""
    start = pose_from_homography(camera, view) if start is None else start
    (pose,), (residuals,) = locate_boards(camera, [view], [start])
    return pose, residuals


def pose_from_homography(camera: Camera, view: PlanarView) -> RigidTransform:
    """Estimate `camera_from_board` of one view linearly: a start for `locate_boards`."""
    # Where the lens folds there is no ray: use the pixel with the lens ignored.
    rays = camera.rays(view.pixels)[:, :2]
    normalized = np.where(np.isfinite(rays), rays, camera.normalized_from_pixels(view.pixels))
    return camera_from_plane(homography(view.points[:, :2], normalized), float(view.points[0, 2]))


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
        lambda state: [_corner_block(state, views, camera_free=False)],
        _State.retract_poses,
        unknowns=6 * len(views),
        steps=30,
        tolerance=tolerance,
    )
    ends = np.cumsum([len(view.points) for view in views])[:-1]
    residuals = solution.blocks[0].residuals.reshape(-1, 2)
    return solution.state.poses, tuple(np.split(residuals, ends))


def _corner_block(state: _State, views: Sequence[PlanarView], *, camera_free: bool = True) -> Block:
    """Reprojection errors, px, one run for each view.

    Derivatives are by the camera's parameters, which come first if free, and by the board's pose.
    """
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
