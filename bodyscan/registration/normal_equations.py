"""The joint solve's normal equations: information of all corners on all unknowns of a rig.

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
from bodyscan.geometry.linear_gaussian import LinearGaussianSystem
from bodyscan.geometry.transforms import RigidTransform, twist_jacobian
from bodyscan.registration.view_graph import Target

CORNERS = Noise("corners", group=2, cauchy=4.0)


@dataclass(frozen=True, eq=False)
class FreeShape:
    """A board whose corners were unknowns of the solve.

    points: (N, 3) mm, board frame, as estimated.
    sigma_mm: prior sigma of each coordinate.
    size_sigma: of the size as a whole, relative, which no view determines.
    """

    points: Array
    sigma_mm: float
    size_sigma: float

    @property
    def prior_information(self) -> Array:
        """Information (3N, 3N) per mm2 before any view: the prior on each coordinate, the gauge
        constraint that the shape has no motion (the board has it), and the prior on its size."""
        arms = self.points - self.points.mean(axis=0)
        motions, _ = np.linalg.qr(twist_jacobian(arms).reshape(-1, 6))
        gauge_mm = 1e-4 * self.sigma_mm  # a thousandth of what views determine
        size = arms.ravel() / np.linalg.norm(arms)
        size_mm = max(self.size_sigma * float(np.linalg.norm(arms)), gauge_mm)
        prior = np.eye(arms.size) / self.sigma_mm**2
        return prior + motions @ motions.T / gauge_mm**2 + np.outer(size, size) / size_mm**2

    def corner_indices(self, points: Array) -> Indices:
        """Indices (M,) of the corners nearest to the points (M, 3) mm of a view."""
        return np.asarray(self._tree.query(points)[1], np.int64)

    @cached_property
    def _tree(self) -> KDTree:
        return KDTree(self.points)


@dataclass(frozen=True, eq=False)
class BoardContribution:
    """The contribution of the views of one board at one moment.

    columns: indices of its unknowns, (C,); the board's motion is the last six.
    """

    columns: Indices
    system: LinearGaussianSystem

    def without_board(self, held: Indices) -> tuple[Indices, LinearGaussianSystem]:
        """Eliminate the board's motion, or fix it if the board holds the frame.

        Returns the free ones of the other columns, and the system of these.
        """
        others, board = np.split(np.arange(len(self.columns)), [-6])
        fixed = self.columns[-1] in held
        reduced = self.system.select(others) if fixed else self.system.marginalize(board)
        free = np.flatnonzero(~np.isin(self.columns[others], held))
        return self.columns[free], reduced.select(free)


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """Normal equations of the joint solve.

    The unknowns are motions of the pairs `names` (6 each), motions of the boards `targets` (6
    each), the parameters of each pair's camera, then the corners of boards whose shape was
    estimated (3 each, board frame, mm).

    parameters: number of parameters of each camera, 0 if cameras are fixed.
    system: J^T W J, px2 per unit of either unknown, and -J^T W r.
    held: unknowns fixed by the definition of the rig frame.
    variance_px2: variance of one coordinate of a corner, in a view of average noise.
    parts: contributions of the targets, in their order; the priors are in none of them.
    """

    names: tuple[str, ...]
    targets: tuple[Target, ...]
    parameters: tuple[int, ...]
    system: LinearGaussianSystem
    held: Indices
    variance_px2: float
    parts: tuple[BoardContribution, ...]

    @property
    def first_board(self) -> int:
        return 6 * len(self.names)

    @property
    def first_camera(self) -> int:
        return self.first_board + 6 * len(self.targets)

    @property
    def camera_columns(self) -> list[Indices]:
        """Indices of the unknowns that are the parameters of each pair's camera."""
        return _split_range(self.first_camera, self.parameters)

    @property
    def cameras_free(self) -> bool:
        return any(self.parameters)

    @property
    def free(self) -> Indices:
        return np.setdiff1d(np.arange(self.system.size), self.held)

    @property
    def rest(self) -> Indices:
        """Indices of all unknowns but the boards' motions."""
        boards = np.arange(self.first_board, self.first_camera)
        return np.setdiff1d(np.arange(self.system.size), boards)

    def without_boards(self) -> LinearGaussianSystem:
        """The system of the unknowns `rest`, with the boards' motions eliminated; a board that
        holds the rig frame is fixed instead."""
        boards = np.arange(self.first_board, self.first_camera)
        fixed = np.intersect1d(boards, self.held)
        kept = np.setdiff1d(np.arange(self.system.size), fixed)
        free_boards = np.flatnonzero(np.isin(kept, boards))
        return self.system.select(kept).marginalize(free_boards)


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
    """Build the joint solve's normal equations at the given poses, with Cauchy weights per corner
    and each view's noise.

    camera_prior: adds the cameras' priors; False where views are to be added to other views.
    shapes: of boards whose corners were unknowns too.

    A corner q in the rig frame is observed at R^T (q - t); a motion of the board and the opposite
    motion of the camera have the same effect on it, so both share one Jacobian.
    """
    names, targets = tuple(sorted(rig_from_camera)), sorted(rig_from_board)
    first_board = 6 * len(names)
    first_camera = first_board + 6 * len(targets)
    parameters = tuple(len(cameras[n].parameters) if cameras_free else 0 for n in names)
    camera_columns = _split_range(first_camera, parameters)
    shapes = shapes or {}
    first_shape = first_camera + sum(parameters)
    sizes = [3 * len(shape.points) for shape in shapes.values()]
    shape_columns = dict(zip(shapes, _split_range(first_shape, sizes), strict=bool(sizes)))
    size = first_shape + sum(len(columns) for columns in shape_columns.values())
    residuals, linearized = zip(
        *(
            reprojection_errors(
                [view], cameras, rig_from_camera, rig_from_board, cameras_free=cameras_free
            )
            for view in views
        ),
        strict=True,
    )
    sigmas = view_sigmas(residuals)
    residuals = tuple(r / sigma for r, sigma in zip(residuals, sigmas, strict=True))
    scale = CORNERS.estimate_scale(np.concatenate(residuals))

    def contribution(number: int, target: Target) -> BoardContribution:
        group = [k for k, view in enumerate(views) if view.target == target]
        board = first_board + 6 * number + np.arange(6)
        pairs = [names.index(views[k].pair) for k in group]
        jacobians = [linearized[k]() / sigmas[k] for k in group]
        columns = [np.concatenate([6 * n + np.arange(6), board, camera_columns[n]]) for n in pairs]
        if target[1] in shapes:
            shape, corners = shapes[target[1]], shape_columns[target[1]].reshape(-1, 3)
            rotation = rig_from_board[target].rotation
            jacobians = [np.hstack([one, _corner_jacobian(one, rotation)]) for one in jacobians]
            columns = [
                np.append(one, corners[shape.corner_indices(views[k].points)])
                for one, k in zip(columns, group, strict=True)
            ]
        return _sum_views([residuals[k] for k in group], jacobians, columns, board, scale)

    parts = [contribution(number, target) for number, target in enumerate(targets)]
    system = LinearGaussianSystem.assemble(((part.columns, part.system) for part in parts), size)
    everything = np.concatenate(residuals)
    weights = CORNERS.weights(everything / scale)
    if fixed_target is not None:
        first_held = first_board + 6 * targets.index(fixed_target)
    else:
        first_held = 6 * names.index(fixed_pair or names[0])
    degrees = max(float(np.sum(weights)) - (size - 6), 1.0)
    variance = float(np.sum(weights * everything**2)) / degrees
    prior = np.zeros((size, size))
    if cameras_free and camera_prior:
        columns = np.concatenate(camera_columns)
        known = np.concatenate([cameras[name].prior_sigmas ** -2 for name in names])
        prior[columns, columns] = max(variance, 1e-12) * known
    for name, columns in shape_columns.items():
        prior[np.ix_(columns, columns)] = max(variance, 1e-12) * shapes[name].prior_information
    return NormalEquations(
        names,
        tuple(targets),
        parameters,
        system + LinearGaussianSystem.from_prior(prior),
        np.arange(first_held, first_held + 6),
        variance,
        tuple(parts),
    )


def _corner_jacobian(jacobian: Array, rotation: Array) -> Array:
    """Derivatives (2N, 3N) of a view's pixels by its corners' positions on the board, from its
    Jacobian (2N, C), whose columns 9 to 11 are by the board's translation, and `rig_from_board`'s
    rotation."""
    count = len(jacobian) // 2
    by_corner = jacobian[:, 9:12] @ rotation
    blocks = np.zeros((count, 2, count, 3))
    blocks[range(count), :, range(count)] = by_corner.reshape(count, 2, 3)
    return blocks.reshape(2 * count, 3 * count)


def view_sigmas(residuals: Sequence[Array]) -> Array:
    """Estimate the noise of each view's corners, (V,), relative to that of all views, from its
    residuals (2N,).

    A board seen at a slant has less to find its corners by: rendered ones err 0.016 px face on and
    0.065 px at 65 degrees. With equal weights the solve would trust just those that it should not,
    and the board on the floor, which fixes the frame, is seen so by every camera.
    """
    # No corner is found better than to 1e-4 px: smaller residuals are of computed views.
    single = np.maximum([CORNERS.mean_square(one) for one in residuals], 1e-8)
    counts = np.array([len(one) for one in residuals], float)
    every = float(single @ counts / counts.sum())
    # Ten residuals know a variance to 45 %: there a view's estimate counts for half.
    shrunk = (10.0 * every + counts * single) / (10.0 + counts)
    # Boards at 65 degrees err 3 times as much; a view that seems worse is wrong, not noisy.
    return np.clip(np.sqrt(shrunk / every), 0.25, 4.0)


def _sum_views(
    residuals: Sequence[Array],
    jacobians: Sequence[Array],
    columns: Sequence[Indices],
    board: Indices,
    scale: float,
) -> BoardContribution:
    """Sum views with residuals (2N,), and jacobians (2N, C) by the unknowns `columns` (C,)."""
    others = np.setdiff1d(np.concatenate([board, *columns]), board)
    every = np.append(others, board)
    row = {column: k for k, column in enumerate(every.tolist())}
    return BoardContribution(
        every,
        LinearGaussianSystem.assemble(
            (
                (
                    np.array([row[column] for column in unknowns.tolist()]),
                    LinearGaussianSystem.from_observations(
                        jacobian, -residual, CORNERS.weights(residual / scale)
                    ),
                )
                for residual, jacobian, unknowns in zip(residuals, jacobians, columns, strict=True)
            ),
            len(every),
        ),
    )


def _split_range(first: int, sizes: Sequence[int]) -> list[Indices]:
    """Consecutive integers from `first`, in runs of the given sizes."""
    return np.split(np.arange(first, first + sum(sizes)), np.cumsum(sizes)[:-1])


def reprojection_errors(
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
