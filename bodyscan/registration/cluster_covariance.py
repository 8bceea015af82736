"""The joint solve's normal equations and the cluster-robust covariance that follows from them.

Corners do not err independently: what lens, light and detector do to one they do to its neighbours,
and to the same board in the same pose again. So all views of a board in one pose are one cluster.
The squared information vector of each, compared with that of independent corners, gives its
variance inflation (a sandwich estimator; Liang and Zeger, Biometrika 73, 1986).
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from bodyscan.arrays import Array, Indices
from bodyscan.boards.view import ViewKey
from bodyscan.calibration.board_views import (
    BoardShape,
    LocatedView,
    apply_shape,
    compute_max_displacement_mm,
)
from bodyscan.calibration.camera import CORNERS
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.linear_gaussian import LinearGaussianSystem
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.geometry.uncertainty import PoseCovariance
from bodyscan.registration.joint_solve import estimate_view_sigmas, linearize_marginalized
from bodyscan.registration.view_graph import Target


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """Normal equations of the joint solve, the boards' motions eliminated.

    The unknowns are motions of the pairs `names` (6 each), the parameters of each pair's camera,
    then the corners of boards whose shape was estimated (3 each, board frame, mm).
    """

    names: tuple[str, ...]
    cameras: dict[str, Indices]  # indices of each camera's parameters
    free: Indices  # indices of the unknowns that the definition of the rig frame does not fix
    prior: LinearGaussianSystem  # the priors on cameras and corners, px2 per unit of either unknown
    # By target, indices (C,) of the unknowns that its views involve, and the system of these: J^T W
    # J, px2 per unit of either unknown, and -J^T W r.
    parts: dict[Target, tuple[Indices, LinearGaussianSystem]]
    variance_px2: float  # variance of one coordinate of a corner, in a view of average noise

    def sum_parts(self, targets: Sequence[Target]) -> LinearGaussianSystem:
        """The system of the free unknowns by these targets alone."""
        parts = [self.parts[target] for target in targets]
        return LinearGaussianSystem.assemble(parts, self.prior.size).select(self.free)

    @property
    def system(self) -> LinearGaussianSystem:
        """The system of the free unknowns by all targets and priors."""
        return self.sum_parts(list(self.parts)) + self.prior.select(self.free)


def build_normal_equations(
    views: Sequence[LocatedView],
    cameras: Mapping[str, Camera],
    rig_from_camera: Mapping[str, RigidTransform],
    rig_from_board: Mapping[Target, RigidTransform],
    *,
    fixed_pair: str | None,
    fixed_target: Target | None,
    shapes: Mapping[str, BoardShape] | None = None,
    motions: Mapping[ViewKey, Array] = MappingProxyType({}),
) -> NormalEquations:
    """Build the joint solve's normal equations, with Cauchy weights and each view's noise.

    fixed_pair, fixed_target: what fixes the rig frame: a pair, or a board, which then has no motion.
    views: of boards as described where there are shapes.
    shapes: of boards whose corners were unknowns too. motions: see `JointSolution`.
    """
    names, shapes = sorted(rig_from_camera), shapes or {}
    sizes = [6] * len(names)
    sizes += [len(cameras[name].parameters) for name in names]
    sizes += [3 * len(shape.points) for shape in shapes.values()]
    size, columns = sum(sizes), np.split(np.arange(sum(sizes)), np.cumsum(sizes)[:-1])
    of_motion, of_camera, of_shape = (
        dict(zip(keys, columns[first:], strict=False))
        for keys, first in ((names, 0), (names, len(names)), (shapes, 2 * len(names)))
    )
    poses = cameras, rig_from_camera, rig_from_board
    true = [apply_shape(view, shapes) for view in views]
    errors = [linearize_marginalized([view], *poses, motions) for view in true]
    sigmas = estimate_view_sigmas([residuals for residuals, _ in errors])
    whitened = [residuals / sigma for (residuals, _), sigma in zip(errors, sigmas, strict=True)]
    scale = CORNERS.estimate_scale(np.concatenate(whitened))
    weights = [CORNERS.weights(residuals / scale) for residuals in whitened]
    board = np.arange(size, size + 6)
    systems: dict[Target, list[tuple[Indices, LinearGaussianSystem]]] = defaultdict(list)
    for k, view in enumerate(views):
        jacobian = errors[k][1]() / sigmas[k]
        jacobian, by_corner = jacobian[:, :-3], jacobian[:, -3:]
        unknowns = [of_motion[view.pair], board, of_camera[view.pair]]
        if view.board in shapes:
            corners = shapes[view.board].numbers(view.points)
            unknowns.append(of_shape[view.board].reshape(-1, 3)[corners].ravel())
            jacobian = np.hstack([jacobian, _by_every_corner(by_corner)])
        system = LinearGaussianSystem.from_observations(jacobian, -whitened[k], weights[k])
        systems[view.target].append((np.concatenate(unknowns), system))
    parts = {
        target: _eliminate_board(of_target, board, target == fixed_target)
        for target, of_target in sorted(systems.items())
    }
    by_size = {name: one.compute_prior_jacobian(one.size_sigma) for name, one in shapes.items()}
    known = [(of_shape[name], each.T @ each) for name, each in by_size.items()]
    known += [(of_camera[name], np.diag(cameras[name].prior_sigmas ** -2)) for name in names]
    priors = [(block, LinearGaussianSystem.from_prior(each)) for block, each in known]
    prior = LinearGaussianSystem.assemble(priors, size)
    free = np.arange(size)
    if fixed_target is None:
        free = np.setdiff1d(free, of_motion[fixed_pair or names[0]])
    of_boards = 6 * len(parts.keys() - {fixed_target})
    found = NormalEquations(tuple(names), of_camera, free, prior, parts, 1.0)
    return _scale_prior(found, np.concatenate(whitened), np.concatenate(weights), of_boards)


def _scale_prior(
    equations: NormalEquations, residuals: Array, weights: Array, eliminated: int
) -> NormalEquations:
    """Estimate the variance, in which the prior of the equations is given.

    eliminated: number of unknowns of the boards.
    """
    squares, total, prior = float(weights @ residuals**2), float(np.sum(weights)), equations.prior
    rough = replace(equations, prior=prior * max(squares / total, 1e-12))
    # What a prior knows of an unknown takes no degree of freedom from the residuals.
    by_views = rough.sum_parts(list(rough.parts)).information
    spent = float(np.sum(by_views * rough.system.covariance())) + eliminated
    variance = max(squares / max(total - spent, 1.0), 1e-12)
    return replace(equations, prior=prior * variance, variance_px2=variance)


def _eliminate_board(
    systems: Sequence[tuple[Indices, LinearGaussianSystem]], board: Indices, is_fixed: bool
) -> tuple[Indices, LinearGaussianSystem]:
    """Sum the systems of one target's views and eliminate its motion, the last of all columns, or
    fix it; returns the columns that remain, and their system."""
    whole = LinearGaussianSystem.assemble(systems, board[-1] + 1)
    involved = np.unique(np.concatenate([columns for columns, _ in systems]))
    others = involved[:-6]
    if is_fixed:
        return others, whole.select(others)
    return others, whole.select(involved).marginalize(np.arange(len(others), len(involved)))


def _by_every_corner(by_corner: Array) -> Array:
    """Derivatives (2N, 3N) by all corners of a view, from those (2N, 3) by each one's position."""
    count = len(by_corner) // 2
    blocks = np.zeros((count, 2, count, 3))
    blocks[range(count), :, range(count)] = by_corner.reshape(count, 2, 3)
    return blocks.reshape(2 * count, 3 * count)


@dataclass(frozen=True, eq=False)
class ClusterRobustCovariance:
    """Covariance of the joint solve's unknowns."""

    poses: PoseCovariance  # of the pairs
    cameras: dict[str, Array]  # (P, P) of each camera's parameters
    # Factor on the variances that independent corners predict, over all clusters.
    variance_inflation: float


def cluster_robust_covariance(
    equations: NormalEquations, clusters: Sequence[Sequence[Target]]
) -> ClusterRobustCovariance:
    """Estimate the sandwich covariance V (sum of f_k H_k + prior) V, V = (sum of H_k + prior)^-1.

    clusters: the targets of each, every target in one.
    """
    free, variance = equations.free, equations.variance_px2
    inverse = equations.system.covariance()
    systems = [equations.sum_parts(cluster) for cluster in clusters]
    inflation, pooled = estimate_variance_inflations(systems, inverse, variance)
    middle = equations.prior.select(free).information  # exact: not inflated
    for factor, system in zip(inflation, systems, strict=True):
        middle = middle + factor * system.information
    covariance = variance * inverse @ middle @ inverse
    full = np.zeros(equations.prior.information.shape)
    full[np.ix_(free, free)] = 0.5 * (covariance + covariance.T)
    pairs = slice(0, 6 * len(equations.names))
    cameras = {name: full[np.ix_(columns, columns)] for name, columns in equations.cameras.items()}
    return ClusterRobustCovariance(
        PoseCovariance(equations.names, full[pairs, pairs]), cameras, pooled
    )


def cluster_board_poses(
    views: Sequence[LocatedView], rig_from_board: Mapping[Target, RigidTransform]
) -> list[list[Target]]:
    """Group targets by board and pose, each with the first one near it.

    Near: no corner is displaced by more than a twentieth of the board's size.
    """
    sizes = {
        name: float(np.linalg.norm(np.ptp(points, axis=0)))
        for name in {view.board for view in views}
        for points in [np.concatenate([view.points for view in views if view.board == name])]
    }
    clusters: list[list[Target]] = []
    for target in sorted({view.target for view in views}):
        size = sizes[target[1]]
        for cluster in clusters:
            first = rig_from_board[cluster[0]]
            if cluster[0][1] == target[1] and (
                compute_max_displacement_mm(first, rig_from_board[target], size) < 0.05 * size
            ):
                cluster.append(target)
                break
        else:
            clusters.append([target])
    return clusters


def estimate_variance_inflations(
    clusters: Sequence[LinearGaussianSystem], covariance: Array, variance: float
) -> tuple[Array, float]:
    """Estimate the variance inflation of each cluster, (K,), and over all clusters.

    clusters: their K systems at the solution.
    covariance: V (P, P) of independent corners of unit variance.
    variance: of a corner's coordinate, px2.

    Of independent corners b^T V b / variance has the expectation tr(S - S S), S = H V being the
    cluster's share of all information: less than tr S because the solve followed the cluster. A
    cluster's own ratio counts for half at 10 degrees of freedom, the rest being that of all.
    """
    traces = []
    for system in clusters:
        share = system.information @ covariance
        kept = share - share @ share
        traces.append((np.trace(kept), np.sum(kept * kept.T)))
    expected, squared = np.array(traces).T
    freedoms = expected**2 / np.maximum(squared, 1e-300)
    vectors = np.array([system.vector for system in clusters])
    found = np.einsum("ki,ij,kj->k", vectors, covariance, vectors) / variance
    if not expected.sum() > 1.0:  # a single cluster: its errors cannot be judged
        return np.ones(len(vectors)), 1.0
    pooled = max(float(found.sum() / expected.sum()), 1.0)
    single = found / np.maximum(expected, 1e-12)
    weight = freedoms / (freedoms + 10.0)
    mixed = weight * single + (1.0 - weight) * pooled
    return np.where(expected > 1e-6, mixed, pooled), pooled
