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

    @staticmethod
    def from_views(
        systems: Sequence[tuple[Indices, LinearGaussianSystem]], board: Indices
    ) -> BoardContribution:
        """Sum the views' systems, each of its own unknowns; board: columns of its motion."""
        every = [board, *(columns for columns, _ in systems)]
        columns = np.append(np.setdiff1d(np.concatenate(every), board), board)
        rows = {column: k for k, column in enumerate(columns.tolist())}
        indexed = [
            (np.array([rows[column] for column in unknowns.tolist()]), system)
            for unknowns, system in systems
        ]
        return BoardContribution(columns, LinearGaussianSystem.assemble(indexed, len(columns)))

    def without_board(self, fixed: Indices) -> tuple[Indices, LinearGaussianSystem]:
        """Eliminate the board's motion, or fix it if the board holds the frame.

        Returns the free ones of the other columns, and the system of these.
        """
        others, board = np.split(np.arange(len(self.columns)), [-6])
        is_fixed = self.columns[-1] in fixed
        reduced = self.system.select(others) if is_fixed else self.system.marginalize(board)
        free = np.flatnonzero(~np.isin(self.columns[others], fixed))
        return self.columns[free], reduced.select(free)


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """Normal equations of the joint solve.

    The unknowns are motions of the pairs `names` (6 each), motions of the boards `targets` (6
    each), the parameters of each pair's camera, then the corners of boards whose shape was
    estimated (3 each, board frame, mm).

    parameters: number of parameters of each camera, 0 if cameras are fixed.
    system: J^T W J, px2 per unit of either unknown, and -J^T W r.
    fixed: unknowns fixed by the definition of the rig frame.
    variance_px2: variance of one coordinate of a corner, in a view of average noise.
    parts: contributions of the targets, in their order; the priors are in none of them.
    """

    names: tuple[str, ...]
    targets: tuple[Target, ...]
    parameters: tuple[int, ...]
    system: LinearGaussianSystem
    fixed: Indices
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
        return np.setdiff1d(np.arange(self.system.size), self.fixed)

    @property
    def rest(self) -> Indices:
        """Indices of all unknowns but the boards' motions."""
        boards = np.arange(self.first_board, self.first_camera)
        return np.setdiff1d(np.arange(self.system.size), boards)

    def without_boards(self) -> LinearGaussianSystem:
        """The system of the unknowns `rest`, with the boards' motions eliminated; a board that
        holds the rig frame is fixed instead."""
        boards = np.arange(self.first_board, self.first_camera)
        fixed_boards = np.intersect1d(boards, self.fixed)
        kept = np.setdiff1d(np.arange(self.system.size), fixed_boards)
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
    """Build the joint solve's normal equations, with Cauchy weights and each view's noise.

    camera_prior: adds the cameras' priors; False where views are to be added to other views.
    shapes: of boards whose corners were unknowns too.
    """
    names, targets = tuple(sorted(rig_from_camera)), sorted(rig_from_board)
    shapes = shapes or {}
    parameters = tuple(len(cameras[n].parameters) if cameras_free else 0 for n in names)
    sizes = [6] * (len(names) + len(targets)) + [*parameters]
    sizes += [3 * len(shape.points) for shape in shapes.values()]
    columns, size = _split_range(0, sizes), sum(sizes)
    board_columns = columns[len(names) :]
    camera_columns = board_columns[len(targets) :]
    corner_columns = dict(zip(shapes, camera_columns[len(names) :], strict=True))
    residuals, jacobians = _whitened_errors(
        views, cameras, rig_from_camera, rig_from_board, cameras_free
    )
    everything = np.concatenate(residuals)
    scale = CORNERS.estimate_scale(everything)

    def contribution(target: Target, board: Indices) -> BoardContribution:
        systems = []
        for k in [k for k, view in enumerate(views) if view.target == target]:
            pair, jacobian = names.index(views[k].pair), jacobians[k]
            unknowns = [columns[pair], board, camera_columns[pair]]
            if target[1] in shapes:
                corners = shapes[target[1]].corner_indices(views[k].points)
                unknowns.append(corner_columns[target[1]].reshape(-1, 3)[corners].ravel())
                jacobian = _append_corners(jacobian, rig_from_board[target].rotation)
            weights = CORNERS.weights(residuals[k] / scale)
            system = LinearGaussianSystem.from_observations(jacobian, -residuals[k], weights)
            systems.append((np.concatenate(unknowns), system))
        return BoardContribution.from_views(systems, board)

    parts = tuple(map(contribution, targets, board_columns))
    weights = CORNERS.weights(everything / scale)
    degrees = max(float(np.sum(weights)) - (size - 6), 1.0)
    variance = float(np.sum(weights * everything**2)) / degrees
    priors = [(corner_columns[name], shapes[name].prior_information) for name in shapes]
    if cameras_free and camera_prior:
        known = [np.diag(cameras[name].prior_sigmas ** -2) for name in names]
        priors += zip(camera_columns, known, strict=False)
    systems = [(part.columns, part.system) for part in parts]
    scaled = ((free, max(variance, 1e-12) * known) for free, known in priors)
    systems += [(free, LinearGaussianSystem.from_prior(known)) for free, known in scaled]
    system = LinearGaussianSystem.assemble(systems, size)
    fixed = columns[[*names, *targets].index(fixed_target or fixed_pair or names[0])]
    return NormalEquations(names, tuple(targets), parameters, system, fixed, variance, parts)


def _whitened_errors(
    views: Sequence[LocatedView],
    cameras: Mapping[str, Camera],
    rig_from_camera: Mapping[str, RigidTransform],
    rig_from_board: Mapping[Target, RigidTransform],
    cameras_free: bool,
) -> tuple[list[Array], list[Array]]:
    """Reprojection errors (2N,) of each view and their Jacobians, over the view's noise."""
    poses = cameras, rig_from_camera, rig_from_board
    errors = [reprojection_errors([view], *poses, cameras_free=cameras_free) for view in views]
    sigmas = view_sigmas([residuals for residuals, _ in errors])
    return (
        [residuals / sigma for (residuals, _), sigma in zip(errors, sigmas, strict=True)],
        [linearize() / sigma for (_, linearize), sigma in zip(errors, sigmas, strict=True)],
    )


def _append_corners(jacobian: Array, rotation: Array) -> Array:
    """Append derivatives (2N, 3N) by the corners' positions on the board to a view's Jacobian
    (2N, C), whose columns 9 to 11 are by the board's translation.

    rotation: that of `rig_from_board`.
    """
    count = len(jacobian) // 2
    by_corner = jacobian[:, 9:12] @ rotation
    blocks = np.zeros((count, 2, count, 3))
    blocks[range(count), :, range(count)] = by_corner.reshape(count, 2, 3)
    return np.hstack([jacobian, blocks.reshape(2 * count, 3 * count)])


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
    parameters if free. A corner q in the rig frame is observed at R^T (q - t): a motion of the board
    and the opposite motion of the camera have the same effect on it.
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
