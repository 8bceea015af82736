"""How well the joint solve knows each placing: the covariance of all pairs in the rig frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bodyscan.calibration.camera import projection_jacobians, twist_jacobian
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.least_squares import cauchy_weights, spread
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.registration.located_view import LocatedView
from bodyscan.registration.view_graph import Target

Array = NDArray[np.float64]

# Cameras are known to about this much before the shots of the rig say more (px, px, 1, 1).
PRIOR_SIGMA = {"focal": 50.0, "centre": 50.0, "k": 0.5}


@dataclass(frozen=True, eq=False)
class PlacingCovariance:
    """Joint covariance (6P, 6P) of small motions of the pairs `names`, rig frame.

    A motion is a rotation vector (radians) about the rig's origin, then a translation (mm).
    """

    names: tuple[str, ...]
    matrix: Array

    def of(self, name: str) -> Array:
        """(6, 6) of one pair's motion."""
        k = 6 * self.names.index(name)
        return self.matrix[k : k + 6, k : k + 6]

    def between(self, a: str, b: str) -> Array:
        """(6, 6) of the motion of b relative to a."""
        i, j = 6 * self.names.index(a), 6 * self.names.index(b)
        m = self.matrix
        rows_i, rows_j = slice(i, i + 6), slice(j, j + 6)
        cross = m[rows_i, rows_j]
        return m[rows_i, rows_i] + m[rows_j, rows_j] - cross - cross.T


def point_covariance(motion_covariance: Array, point: Array) -> Array:
    """(3, 3) mm2: how a rig point (3,) carried by such a motion (6, 6) is spread."""
    jacobian = twist_jacobian(point[None])[0]
    return jacobian @ motion_covariance @ jacobian.T


def position_sigma(covariance: PlacingCovariance, name: str, position: Array) -> Array:
    """(3,) mm: standard deviation of a pair's camera centre (3,) along the rig's axes."""
    return np.sqrt(np.diag(point_covariance(covariance.of(name), position)))


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """What all corners say of all unknowns: J^T W J, px-2 times units.

    Unknowns: motions of the pairs `names` (6 each), motions of the boards `targets` (6 each), then
    lenses (focal length, u0, v0, k1, k2 of each pair) if `cameras_free`.  held: unknowns that the
    rig frame's definition fixes.  variance_px2: of a corner's coordinate.
    """

    names: tuple[str, ...]
    targets: tuple[Target, ...]
    cameras_free: bool
    matrix: Array
    held: NDArray[np.int64]
    variance_px2: float

    @property
    def first_board(self) -> int:
        return 6 * len(self.names)

    @property
    def first_lens(self) -> int:
        return self.first_board + 6 * len(self.targets)

    def covariance(self) -> PlacingCovariance:
        """Of the pairs' motions, all other unknowns left free."""
        size = len(self.matrix)
        free = np.setdiff1d(np.arange(size), self.held)
        full = np.zeros((size, size))
        full[np.ix_(free, free)] = self.variance_px2 * scaled_inverse(
            self.matrix[np.ix_(free, free)]
        )
        pairs = slice(0, self.first_board)
        return PlacingCovariance(self.names, full[pairs, pairs])

    def without_boards(self) -> Array:
        """(11P, 11P), or (6P, 6P): information on pairs and lenses, the boards eliminated.

        A board that holds the rig frame is known instead. Source: Schur complement, Triggs et al.,
        Bundle Adjustment - A Modern Synthesis, 2000, 6.1.
        """
        size = len(self.matrix)
        boards = np.arange(self.first_board, self.first_lens)
        rest = np.setdiff1d(np.arange(size), boards)
        boards = np.setdiff1d(boards, self.held)
        cross = self.matrix[np.ix_(rest, boards)]
        inverse = scaled_inverse(self.matrix[np.ix_(boards, boards)])
        return self.matrix[np.ix_(rest, rest)] - cross @ inverse @ cross.T


def scaled_inverse(matrix: Array) -> Array:
    """Pseudo-inverse of a symmetric matrix whose unknowns have units of very different size."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    reduced = matrix * np.outer(scale, scale)
    inverse = np.linalg.pinv(reduced, rcond=1e-14, hermitian=True)
    return np.asarray(inverse * np.outer(scale, scale))


def placing_covariance(
    views: Sequence[LocatedView],
    cameras: dict[str, Camera],
    rig_from_camera: dict[str, RigidTransform],
    rig_from_board: dict[Target, RigidTransform],
    *,
    fixed_pair: str | None,
    fixed_target: Target | None,
    cameras_free: bool,
) -> PlacingCovariance:
    """Covariance of every `rig_from_camera`, the rig frame held by one pair or one board.

    With `cameras_free` the focal length, centre, k1 and k2 of each camera are unknowns too (as in
    the joint solve).
    """
    equations = normal_equations(
        views,
        cameras,
        rig_from_camera,
        rig_from_board,
        fixed_pair=fixed_pair,
        fixed_target=fixed_target,
        cameras_free=cameras_free,
    )
    return equations.covariance()


def normal_equations(
    views: Sequence[LocatedView],
    cameras: Mapping[str, Camera],
    rig_from_camera: Mapping[str, RigidTransform],
    rig_from_board: Mapping[Target, RigidTransform],
    *,
    fixed_pair: str | None,
    fixed_target: Target | None,
    cameras_free: bool,
    lens_prior: bool = True,
) -> NormalEquations:
    """The joint solve's normal equations at its solution.

    A corner q of the rig frame is seen at R^T (q - t); a motion of the board and the opposite
    motion of the camera change that alike, so both share one Jacobian.  `lens_prior` adds what is
    known of lenses beforehand; leave it out where views are to be added to other views.
    """
    names = tuple(sorted(rig_from_camera))
    targets = sorted(rig_from_board)
    first_board = 6 * len(names)
    first_lens = first_board + 6 * len(targets)
    size = first_lens + (5 * len(names) if cameras_free else 0)
    normal = np.zeros((size, size))
    squared, count = [], 0
    for view in views:
        jacobian, residuals = _view_jacobian(view, cameras, rig_from_camera, rig_from_board)
        weights = cauchy_weights(residuals, 2, 4.0 * spread(residuals))
        number = names.index(view.pair)
        columns = np.concatenate(
            [
                np.arange(6 * number, 6 * number + 6),
                first_board + 6 * targets.index(view.target) + np.arange(6),
                first_lens + 5 * number + np.arange(5) if cameras_free else [],
            ]
        ).astype(int)
        block = jacobian[:, : len(columns)]
        normal[np.ix_(columns, columns)] += block.T @ (block * weights[:, None])
        squared.append(weights * residuals**2)
        count += len(residuals)
    if cameras_free and lens_prior:
        prior = [PRIOR_SIGMA["focal"], *[PRIOR_SIGMA["centre"]] * 2, *[PRIOR_SIGMA["k"]] * 2]
        lens = np.arange(first_lens, size)
        normal[lens, lens] += np.tile(1.0 / np.array(prior) ** 2, len(names))
    held = _held(names, targets, first_board, fixed_pair, fixed_target)
    variance = float(np.sum(np.concatenate(squared))) / max(count - (size - len(held)), 1)
    return NormalEquations(names, tuple(targets), cameras_free, normal, held, variance)


def _held(
    names: tuple[str, ...],
    targets: list[Target],
    first_board: int,
    fixed_pair: str | None,
    fixed_target: Target | None,
) -> NDArray[np.int64]:
    if fixed_target is not None:
        start = first_board + 6 * targets.index(fixed_target)
    else:
        start = 6 * names.index(fixed_pair or names[0])
    return np.arange(start, start + 6)


def _view_jacobian(
    view: LocatedView,
    cameras: Mapping[str, Camera],
    rig_from_camera: Mapping[str, RigidTransform],
    rig_from_board: Mapping[Target, RigidTransform],
) -> tuple[Array, Array]:
    """d(pixels) (2N, 17) by camera motion, board motion, lens (focal, u0, v0, k1, k2); residuals."""
    camera = cameras[view.pair]
    in_rig = rig_from_board[view.target].apply(view.points)
    camera_from_rig = rig_from_camera[view.pair].inverse()
    points = camera_from_rig.apply(in_rig)
    lens, by_point = projection_jacobians(camera, points)
    by_motion = by_point @ camera_from_rig.rotation @ twist_jacobian(in_rig)
    focal = lens[:, :, :1] + lens[:, :, 1:2] * (camera.beta / camera.alpha)
    jacobian = np.concatenate([-by_motion, by_motion, focal, lens[:, :, 3:]], axis=2)
    residuals = camera.project(points) - view.pixels
    return jacobian.reshape(-1, jacobian.shape[2]), residuals.ravel()
