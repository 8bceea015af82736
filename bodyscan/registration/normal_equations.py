"""The joint solve's normal equations: what all corners say about all unknowns of a rig.

They give the covariance of every pose, what further shots would add, and the last steps of the
solve itself, including what COLMAP's cameras lack (skew, non-square pixels).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import KDTree

from bodyscan.arrays import Array, Indices
from bodyscan.calibration.board_views import LocatedView
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.least_squares import Noise
from bodyscan.geometry.linear_gaussian import invert_scaled
from bodyscan.geometry.transforms import RigidTransform, twist_jacobian
from bodyscan.registration.view_graph import Target

CORNERS = Noise("corners", group=2, cauchy=4.0)
KNOWN_FROM = 10.0
"""Residuals at which a view's own noise counts for half, the rest being that of all views: ten know
a variance to 45 %; of 40 to 96, as views have, the six that its board's pose takes matter little."""
MOST_NOISE = 4.0
"""Times the noise of all views: boards at 65 degrees err 3 times as much; a view that seems worse
is wrong rather than noisy, which is judged elsewhere."""
FINEST_PX = 1e-4
"""No corner is found as well as that; residuals below it are those of computed views."""
HELD = 1e-4
"""Of a shape's prior sigma: what its motion and size are held to, a thousandth of what views tell."""


@dataclass(frozen=True, eq=False)
class FreeShape:
    """A board whose corners were unknowns of the solve.

    points: (N, 3) mm, board frame, where they were found.
    sigma_mm: of each coordinate, beforehand.
    size_sigma: of the size as a whole, relative, which no view tells.
    """

    points: Array
    sigma_mm: float
    size_sigma: float

    @property
    def known(self) -> Array:
        """Information (3N, 3N) per mm2 that was there before any view: the prior, that the shape
        has no motion of its own, since the board has it, and its size."""
        arms = self.points - self.points.mean(axis=0)
        motions, _ = np.linalg.qr(twist_jacobian(arms).reshape(-1, 6))
        held = HELD * self.sigma_mm
        size = arms.ravel() / np.linalg.norm(arms)
        size_mm = max(self.size_sigma * float(np.linalg.norm(arms)), held)
        own = np.eye(arms.size) / self.sigma_mm**2
        return own + motions @ motions.T / held**2 + np.outer(size, size) / size_mm**2

    def numbers(self, points: Array) -> Indices:
        """Which corners (M,) the points (M, 3) mm of a view are."""
        return np.asarray(self._tree.query(points)[1], np.int64)

    @cached_property
    def _tree(self) -> KDTree:
        return KDTree(self.points)


@dataclass(frozen=True, eq=False)
class OfTarget:
    """The contribution of the views of one board at one moment.

    columns: indices of its unknowns, (C,); the board's own motion is the last six.
    matrix: J^T W J, (C, C).
    gradient: J^T W r, (C,).
    """

    columns: Indices
    matrix: Array
    gradient: Array


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """Normal equations of the joint solve.

    The unknowns are motions of the pairs `names` (6 each), motions of the boards `targets` (6
    each), the parameters of each pair's camera, then the corners of boards whose shape was found
    (3 each, board frame, mm).

    parameters: number of parameters of each camera, 0 if cameras are held.
    matrix: J^T W J, px2 per unit of either unknown.
    gradient: J^T W r.
    held: unknowns fixed by the definition of the rig frame.
    variance_px2: variance of one coordinate of a corner, in a view as noisy as all together.
    parts: contributions of the targets, in their order; the priors are in none of them.
    """

    names: tuple[str, ...]
    targets: tuple[Target, ...]
    parameters: tuple[int, ...]
    matrix: Array
    gradient: Array
    held: Indices
    variance_px2: float
    parts: tuple[OfTarget, ...]

    @property
    def first_board(self) -> int:
        return 6 * len(self.names)

    @property
    def first_camera(self) -> int:
        return self.first_board + 6 * len(self.targets)

    @property
    def camera_columns(self) -> list[Indices]:
        """Indices of the unknowns that are the parameters of each pair's camera."""
        return _runs(self.first_camera, self.parameters)

    @property
    def cameras_free(self) -> bool:
        return any(self.parameters)

    @property
    def free(self) -> Indices:
        return np.setdiff1d(np.arange(len(self.matrix)), self.held)

    def without_boards(self) -> Array:
        """Information on pairs and cameras, with the boards eliminated.

        A board that holds the rig frame is known instead. Source: Schur complement, Triggs et al.,
        Bundle Adjustment - A Modern Synthesis, 2000, 6.1.
        """
        size = len(self.matrix)
        boards = np.arange(self.first_board, self.first_camera)
        rest = np.setdiff1d(np.arange(size), boards)
        boards = np.setdiff1d(boards, self.held)
        cross = self.matrix[np.ix_(rest, boards)]
        inverse = invert_scaled(self.matrix[np.ix_(boards, boards)])
        return self.matrix[np.ix_(rest, rest)] - cross @ inverse @ cross.T


def normal_equations(
    views: Sequence[LocatedView],
    cameras: Mapping[str, Camera],
    rig_from_camera: Mapping[str, RigidTransform],
    rig_from_board: Mapping[Target, RigidTransform],
    *,
    fixed_pair: str | None,
    fixed_target: Target | None,
    cameras_free: bool,
    camera_prior: bool = True,
    shapes: Mapping[str, FreeShape] | None = None,
) -> NormalEquations:
    """The joint solve's normal equations at the given poses, with Cauchy weights per corner and
    each view's own noise.

    camera_prior: adds the cameras' priors; False where views are to be added to other views.
    shapes: of boards whose corners were unknowns too.

    A corner q in the rig frame is seen at R^T (q - t); a motion of the board and the opposite
    motion of the camera change that alike, so both share one Jacobian.
    """
    names = tuple(sorted(rig_from_camera))
    targets = sorted(rig_from_board)
    first_board = 6 * len(names)
    first_camera = first_board + 6 * len(targets)
    parameters = tuple(len(cameras[n].parameters) if cameras_free else 0 for n in names)
    camera_columns = _runs(first_camera, parameters)
    shapes = shapes or {}
    first_shape = first_camera + sum(parameters)
    sizes = [3 * len(shape.points) for shape in shapes.values()]
    of_shape = dict(zip(shapes, _runs(first_shape, sizes), strict=bool(sizes)))
    size = first_shape + sum(len(columns) for columns in of_shape.values())
    residuals, linearized = zip(
        *(
            corners_seen(
                [view], cameras, rig_from_camera, rig_from_board, cameras_free=cameras_free
            )
            for view in views
        ),
        strict=True,
    )
    sigmas = view_sigmas(residuals)
    residuals = tuple(r / sigma for r, sigma in zip(residuals, sigmas, strict=True))
    spread = CORNERS.estimate_scale(np.concatenate(residuals))

    def of_target(number: int, target: Target) -> OfTarget:
        seen = [k for k, view in enumerate(views) if view.target == target]
        board = first_board + 6 * number + np.arange(6)
        pairs = [names.index(views[k].pair) for k in seen]
        jacobians = [linearized[k]() / sigmas[k] for k in seen]
        columns = [np.concatenate([6 * n + np.arange(6), board, camera_columns[n]]) for n in pairs]
        if target[1] in shapes:
            shape, own = shapes[target[1]], of_shape[target[1]].reshape(-1, 3)
            turn = rig_from_board[target].rotation
            numbers = [shape.numbers(views[k].points) for k in seen]
            jacobians = [np.hstack([one, _by_corner(one, turn)]) for one in jacobians]
            columns = [
                np.append(one, own[which]) for one, which in zip(columns, numbers, strict=True)
            ]
        return _of_target([residuals[k] for k in seen], jacobians, columns, board, spread)

    parts = [of_target(number, target) for number, target in enumerate(targets)]
    normal, gradient = _total(parts, size)
    everything = np.concatenate(residuals)
    weights = CORNERS.weights(everything / spread)
    held = _held(names, targets, first_board, fixed_pair, fixed_target)
    degrees = max(float(np.sum(weights)) - (size - len(held)), 1.0)
    variance = float(np.sum(weights * everything**2)) / degrees
    if cameras_free and camera_prior:
        own = np.concatenate(camera_columns)
        known = np.concatenate([cameras[name].prior_sigmas ** -2 for name in names])
        normal[own, own] += max(variance, 1e-12) * known
    for name, columns in of_shape.items():
        normal[np.ix_(columns, columns)] += max(variance, 1e-12) * shapes[name].known
    return NormalEquations(
        names, tuple(targets), parameters, normal, gradient, held, variance, tuple(parts)
    )


def _by_corner(jacobian: Array, turn: Array) -> Array:
    """Derivatives (2N, 3N) by the places of a view's corners, from its Jacobian (2N, C) and the
    rotation `rig_from_board`: a board's translation moves every corner alike."""
    count = len(jacobian) // 2
    each = jacobian[:, 9:12] @ turn
    apart = np.zeros((count, 2, count, 3))
    apart[range(count), :, range(count)] = each.reshape(count, 2, 3)
    return apart.reshape(2 * count, 3 * count)


def view_sigmas(residuals: Sequence[Array]) -> Array:
    """How noisy the corners of each view are, (V,), from its residuals (2N,): 1 as all together.

    A board seen at a slant has less to find its corners by: rendered ones err 0.016 px face on and
    0.065 px at 65 degrees. Were all thought alike, the solve would trust just those that it should
    not, and the board on the floor, which holds the frame, is seen so by every camera.
    """
    own = np.maximum([CORNERS.mean_square(one) for one in residuals], FINEST_PX**2)
    counts = np.array([len(one) for one in residuals], float)
    every = float(own @ counts / counts.sum())
    shrunk = (KNOWN_FROM * every + counts * own) / (KNOWN_FROM + counts)
    return np.clip(np.sqrt(shrunk / every), 1.0 / MOST_NOISE, MOST_NOISE)


def _total(parts: Sequence[OfTarget], size: int) -> tuple[Array, Array]:
    """Normal matrix (size, size) and gradient (size,)."""
    normal, gradient = np.zeros((size, size)), np.zeros(size)
    for part in parts:
        normal[np.ix_(part.columns, part.columns)] += part.matrix
        gradient[part.columns] += part.gradient
    return normal, gradient


def _of_target(
    residuals: Sequence[Array],
    jacobians: Sequence[Array],
    columns: Sequence[Indices],
    board: Indices,
    spread: float,
) -> OfTarget:
    """From views with residuals (2N,), and jacobians (2N, C) by the unknowns `columns` (C,)."""
    others = np.setdiff1d(np.concatenate([board, *columns]), board)
    every = np.append(others, board)
    place = {column: k for k, column in enumerate(every.tolist())}
    matrix, gradient = np.zeros((len(every), len(every))), np.zeros(len(every))
    for residual, jacobian, own in zip(residuals, jacobians, columns, strict=True):
        rows = np.array([place[column] for column in own.tolist()])
        weighted = jacobian * CORNERS.weights(residual / spread)[:, None]
        matrix[np.ix_(rows, rows)] += jacobian.T @ weighted
        gradient[rows] += weighted.T @ residual
    return OfTarget(every, matrix, gradient)


def _runs(first: int, sizes: Sequence[int]) -> list[Indices]:
    """Consecutive numbers from `first`, in runs of the given sizes."""
    return np.split(np.arange(first, first + sum(sizes)), np.cumsum(sizes)[:-1])


def _held(
    names: tuple[str, ...],
    targets: list[Target],
    first_board: int,
    fixed_pair: str | None,
    fixed_target: Target | None,
) -> Indices:
    if fixed_target is not None:
        start = first_board + 6 * targets.index(fixed_target)
    else:
        start = 6 * names.index(fixed_pair or names[0])
    return np.arange(start, start + 6)


def corners_seen(
    views: Sequence[LocatedView],
    cameras: Mapping[str, Camera],
    rig_from_camera: Mapping[str, RigidTransform],
    rig_from_board: Mapping[Target, RigidTransform],
    *,
    cameras_free: bool,
) -> tuple[Array, Callable[[], Array]]:
    """Reprojection errors (2N,) px of one pair's views, and a function for their Jacobian.

    The Jacobian (2N, 12 + P) is by the camera's motion, each board's motion, and the camera's
    parameters if free.
    """
    pair = views[0].pair
    camera = cameras[pair]
    in_rig = np.concatenate([rig_from_board[view.target].apply(view.points) for view in views])
    pixels = np.concatenate([view.pixels for view in views])
    camera_from_rig = rig_from_camera[pair].inverse()
    points = camera_from_rig.apply(in_rig)

    def linearize() -> Array:
        by_parameter, by_point = camera.jacobians(points)
        by_motion = by_point @ camera_from_rig.rotation @ twist_jacobian(in_rig)
        parts = [-by_motion, by_motion, *([by_parameter] if cameras_free else [])]
        jacobian = np.concatenate(parts, axis=2)
        return jacobian.reshape(-1, jacobian.shape[2])

    return (camera.project(points) - pixels).ravel(), linearize
