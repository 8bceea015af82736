"""The camera of a pair: maximum likelihood over intrinsics and board poses, with covariance (3.1)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache

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
from bodyscan.geometry.least_squares import EXACT, Block, Noise, minimize
from bodyscan.geometry.lenses.lens import Lens
from bodyscan.geometry.lenses.radial import Radial
from bodyscan.geometry.ray_uncertainty import RayUncertainty
from bodyscan.geometry.transforms import RigidTransform, twist_jacobian

FEWEST_POSES = 3
SETTLED = 1e-6
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
    """A camera and `camera_from_board` of each of its views, with what that leaves over.

    residuals: (N, 2) px of each view.  weights: (N,) of each, robust.  covariance: (P, P).
    """

    camera: Camera
    poses: tuple[RigidTransform, ...]
    residuals: tuple[Array, ...]
    weights: tuple[Array, ...]
    covariance: Array

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
        twists = step[size:].reshape(-1, 6)
        poses = tuple(pose.moved(twist) for pose, twist in zip(self.poses, twists, strict=True))
        return _State(self.camera.moved(step[:size]), poses)


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
) -> CameraFit:
    """Least squares over camera and boards from where they are, `camera_from_board` of each view."""
    size = len(camera.parameters)
    solution = minimize(
        _State(camera, tuple(poses)),
        lambda state: [
            *_corners_of_all(state, views),
            known_beforehand(state.camera, np.arange(size)),
        ],
        _State.moved,
        unknowns=size + 6 * len(views),
        settled=settled,
    )
    return CameraFit(
        solution.state.camera,
        solution.state.poses,
        tuple(block.residuals.reshape(-1, 2) for block in solution.blocks[:-1]),
        tuple(weights[::2] for weights in solution.weights[:-1]),
        solution.variance * solution.covariance[:size, :size],
    )


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
    if start is None:
        # Where the lens folds, the pixel without its lens has to do for a start.
        seen = camera.rays(view.pixels)[:, :2]
        normalized = np.where(np.isfinite(seen), seen, camera.normalized_from_pixels(view.pixels))
        start = camera_from_plane(
            homography(view.points[:, :2], normalized), float(view.points[0, 2])
        )
    solution = minimize(
        start,
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


def _corners_of_all(state: _State, views: Sequence[PlanarView]) -> list[Block]:
    """Reprojection errors, px, of each view; by the camera's parameters, which come first, and by its
    board's pose."""
    placed = zip(state.poses, views, strict=True)
    points = np.concatenate([pose.apply(view.points) for pose, view in placed])
    cuts = np.cumsum([len(view.points) for view in views])[:-1]
    seen = np.split(state.camera.project(points), cuts)

    @cache
    def linearize() -> list[Array]:
        by_parameter, by_point = state.camera.jacobians(points)
        jacobian = np.concatenate([by_parameter, by_point @ twist_jacobian(points)], axis=2)
        return np.split(jacobian, cuts)

    def of_view(k: int) -> Callable[[], Array]:
        return lambda: linearize()[k].reshape(-1, size + 6)

    size = len(state.camera.parameters)
    own = np.arange(size)
    return [
        Block(
            (seen[k] - view.pixels).ravel(),
            of_view(k),
            np.append(own, size + 6 * k + np.arange(6)),
            CORNERS,
        )
        for k, view in enumerate(views)
    ]


def _corners(camera: Camera, pose: RigidTransform, view: PlanarView) -> Block:
    """One view's reprojection errors, px, by its board's pose."""
    points = pose.apply(view.points)

    def linearize() -> Array:
        by_pose = camera.jacobians(points)[1] @ twist_jacobian(points)
        return by_pose.reshape(-1, 6)

    residuals = (camera.project(points) - view.pixels).ravel()
    return Block(residuals, linearize, slice(0, 6), CORNERS)
