"""The camera of a pair: maximum likelihood over intrinsics and board poses, with covariance (3.1)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from bodyscan.arrays import Array, Indices
from bodyscan.calibration.board_views import PlanarView
from bodyscan.calibration.zhang import (
    camera_from_plane,
    homography,
    matrix_from_homographies,
)
from bodyscan.errors import DegeneratePoses
from bodyscan.geometry.camera import MATRIX, Camera
from bodyscan.geometry.least_squares import EXACT, Block, Noise, Solution, minimize
from bodyscan.geometry.lenses.lens import Lens
from bodyscan.geometry.lenses.radial import Radial
from bodyscan.geometry.ray_uncertainty import RayUncertainty
from bodyscan.geometry.transforms import RigidTransform, twist_jacobian

FEWEST_POSES = 3
SETTLED = 1e-6
DAMPING = 1e-3
CHAPTERS_LENS = Radial()
CORNERS = Noise("corners", group=2, cauchy=4.0)


@dataclass(frozen=True)
class LensTrial:
    """How one kind of lens did on boards that it was not fitted to.

    rms_px: of their corners, robustly weighted.  gain: by how many of its own standard errors it did
    better than the lens it was tried against (the one chosen so far); None for the first.
    """

    kind: str
    rms_px: float
    gain: float | None = None
    chosen: bool = False


@dataclass(frozen=True, eq=False)
class CameraCalibration:
    """camera with the covariance (P, P) of its parameters, and the board's pose in each shot.

    rms_px: root mean square distance of corners to their reprojection, robustly weighted.
    lenses: those tried on held-out boards; empty where the lens was given.  rays: how well each
    pixel's is known; None where nobody asked.
    """

    camera: Camera
    covariance: Array
    camera_from_board: dict[str, RigidTransform]
    residuals_px: dict[str, Array]
    rms_px: float
    lenses: tuple[LensTrial, ...] = ()
    rays: RayUncertainty | None = None


@dataclass(frozen=True, eq=False)
class CameraFit:
    """A camera and `camera_from_board` of each of its views, with what that leaves over."""

    solution: Solution[_State]

    @property
    def camera(self) -> Camera:
        return self.solution.state.camera

    @property
    def poses(self) -> tuple[RigidTransform, ...]:
        return self.solution.state.poses

    @property
    def residuals(self) -> tuple[Array, ...]:
        """(N, 2) px of each view."""
        corners = self.solution.blocks[0]
        return _by_view(corners.residuals.reshape(-1, 2), corners)

    @property
    def weights(self) -> tuple[Array, ...]:
        """(N,) of each view's corners, robust."""
        return _by_view(self.solution.weights[0][::2], self.solution.blocks[0])

    @cached_property
    def covariance(self) -> Array:
        """(P, P) of the camera's parameters."""
        size = len(self.camera.parameters)
        return self.solution.variance * self.solution.covariance[:size, :size]

    @property
    def rms_px(self) -> float:
        """Robustly weighted."""
        return weighted_rms(self.residuals, self.weights)

    def calibration(self, views: Sequence[PlanarView]) -> CameraCalibration:
        """Of the views it was fitted to."""
        shots = [view.shot for view in views]
        return CameraCalibration(
            self.camera,
            self.covariance,
            dict(zip(shots, self.poses, strict=True)),
            dict(zip(shots, self.residuals, strict=True)),
            self.rms_px,
        )


@dataclass(frozen=True, eq=False)
class _State:
    camera: Camera
    poses: tuple[RigidTransform, ...]

    def moved(self, step: Array) -> _State:
        size = len(self.camera.parameters)
        return _State(self.camera.moved(step[:size]), self.boards_moved(step[size:]).poses)

    def boards_moved(self, step: Array) -> _State:
        twists = zip(self.poses, step.reshape(-1, 6), strict=True)
        return _State(self.camera, tuple(pose.moved(twist) for pose, twist in twists))


def calibrate_camera(
    views: Sequence[PlanarView], width: int, height: int, lens: Lens = CHAPTERS_LENS
) -> CameraCalibration:
    """Zhang's method with skew, and with a lens of the kind of `lens`, which it starts from.

    Raises DegeneratePoses for fewer than three poses or poses that differ by a translation only.
    """
    return fit_from_scratch(views, width, height, lens).calibration(views)


def calibrate_known_camera(views: Sequence[PlanarView], camera: Camera) -> CameraCalibration:
    """A camera with a prior, which its views may move as far as that lets them; one will do.

    Raises DegeneratePoses if there is none.
    """
    if not views:
        raise DegeneratePoses(
            "no board was seen well enough by a camera that is known",
            remedy="show it the board in a shot that others see too",
        )
    poses = [locate_board(camera, view)[0] for view in views]
    return fit_camera(camera, poses, views).calibration(views)


def fit_from_scratch(
    views: Sequence[PlanarView], width: int, height: int, lens: Lens = CHAPTERS_LENS
) -> CameraFit:
    """As `calibrate_camera`."""
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
    return fit_camera(camera, poses, views)


def fit_camera(
    camera: Camera,
    poses: Sequence[RigidTransform],
    views: Sequence[PlanarView],
    *,
    settled: float = SETTLED,
    damping: float = DAMPING,
) -> CameraFit:
    """Least squares over camera and boards from where they are, `camera_from_board` of each view;
    damping: see `minimize`."""
    size = len(camera.parameters)
    solution = minimize(
        _State(camera, tuple(poses)),
        lambda state: [
            _corners_of_all(state, views),
            known_beforehand(state.camera, np.arange(size)),
        ],
        _State.moved,
        unknowns=size + 6 * len(views),
        settled=settled,
        damping=damping,
    )
    return CameraFit(solution)


def weighted_rms(residuals: Sequence[Array], weights: Sequence[Array]) -> float:
    """Of distances (N, 2) px with weights (N,), view by view."""
    weight = np.concatenate(weights)
    squared = np.sum(np.concatenate(residuals) ** 2, axis=1)
    return float(np.sqrt(np.sum(weight * squared) / np.sum(weight)))


def known_beforehand(camera: Camera, columns: Indices) -> Block:
    """What is known of a camera by itself: its prior if it has one, else that its lens bends little;
    `columns` are its parameters'."""
    if camera.prior is None:
        return lens_prior(camera, columns[len(MATRIX) :])
    known = 1.0 / camera.prior.sigmas
    away = known * (camera.parameters - camera.prior.parameters)
    return Block(away, lambda: np.diag(known), columns, EXACT)


def lens_prior(camera: Camera, columns: Indices) -> Block:
    """What is known of the lens beforehand: that it bends little. Keeps coefficients that the boards
    leave open, or only the sum of, from running off; `columns` are theirs."""
    known = 1.0 / camera.lens.prior_sigmas
    return Block(known * camera.lens.coefficients, lambda: np.diag(known), columns, EXACT)


def locate_board(
    camera: Camera, view: PlanarView, start: RigidTransform | None = None
) -> tuple[RigidTransform, Array]:
    """`camera_from_board` of one view for a known camera, and its residuals (N, 2) px."""
    begun = roughly_located(camera, view) if start is None else start
    (pose,), (residuals,) = locate_boards(camera, [view], [begun])
    return pose, residuals


def roughly_located(camera: Camera, view: PlanarView) -> RigidTransform:
    """`camera_from_board` of one view by its homography: where `locate_boards` may start."""
    # Where the lens folds, the pixel without its lens has to do.
    seen = camera.rays(view.pixels)[:, :2]
    normalized = np.where(np.isfinite(seen), seen, camera.normalized_from_pixels(view.pixels))
    return camera_from_plane(homography(view.points[:, :2], normalized), float(view.points[0, 2]))


def locate_boards(
    camera: Camera,
    views: Sequence[PlanarView],
    starts: Sequence[RigidTransform],
    *,
    settled: float = SETTLED,
) -> tuple[tuple[RigidTransform, ...], tuple[Array, ...]]:
    """`camera_from_board` of views whose corners err alike, for a known camera, and the residuals
    (N, 2) px of each."""
    solution = minimize(
        _State(camera, tuple(starts)),
        lambda state: [_corners_of_all(state, views, camera_free=False)],
        _State.boards_moved,
        unknowns=6 * len(views),
        steps=30,
        settled=settled,
    )
    corners = solution.blocks[0]
    return solution.state.poses, _by_view(corners.residuals.reshape(-1, 2), corners)


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


def _corners_of_all(
    state: _State, views: Sequence[PlanarView], *, camera_free: bool = True
) -> Block:
    """Reprojection errors, px, a run for each view; by the camera's parameters, which come first if
    free, and by its board's pose."""
    placed = zip(state.poses, views, strict=True)
    points = np.concatenate([pose.apply(view.points) for pose, view in placed])
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


def _by_view(values: Array, corners: Block) -> tuple[Array, ...]:
    """What each corner of a block has, view by view."""
    assert corners.runs is not None
    return tuple(np.split(values, np.cumsum(corners.runs)[:-1] // 2))
