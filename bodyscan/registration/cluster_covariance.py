"""Cluster-robust covariance of the joint solve: board poses are the clusters.

Corners do not err independently: what lens, light and detector do to one they do to its neighbours,
and to the same board in the same pose again. So all views of a board in one pose are one cluster.
The squared information vector of each, compared with that of independent corners, gives its
variance inflation (a sandwich estimator; Liang and Zeger, Biometrika 73, 1986).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bodyscan.arrays import Array
from bodyscan.calibration.board_views import LocatedView, max_displacement_mm
from bodyscan.geometry.linear_gaussian import LinearGaussianSystem
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.geometry.uncertainty import PoseCovariance
from bodyscan.registration.normal_equations import NormalEquations
from bodyscan.registration.view_graph import Target


@dataclass(frozen=True, eq=False)
class ClusterRobustCovariance:
    """Covariance of the joint solve's unknowns.

    poses: of the pairs.
    cameras: (P, P) of each camera's parameters, where they were free.
    variance_inflation: factor on the variances that independent corners predict, over all clusters.
    """

    poses: PoseCovariance
    cameras: dict[str, Array]
    variance_inflation: float


def cluster_robust_covariance(
    equations: NormalEquations, clusters: Sequence[Sequence[Target]]
) -> ClusterRobustCovariance:
    """Estimate the sandwich covariance V (sum of f_k H_k + prior) V, V = (sum of H_k + prior)^-1.

    clusters: the targets of each, every target in one.
    """
    reduced, rest = equations.without_boards(), equations.rest
    free = np.flatnonzero(~np.isin(rest, equations.fixed))
    rest, reduced = rest[free], reduced.select(free)
    number = {target: k for k, targets in enumerate(clusters) for target in targets}
    information = np.zeros((len(clusters), len(rest), len(rest)))
    vectors = np.zeros((len(clusters), len(rest)))
    for target, part in zip(equations.targets, equations.parts, strict=True):
        columns, system = part.without_board(equations.fixed)
        where, k = np.searchsorted(rest, columns), number[target]
        information[k][np.ix_(where, where)] += system.information
        vectors[k][where] += system.vector
    inverse, variance = reduced.covariance(), equations.variance_px2
    inflation, pooled = variance_inflations(
        LinearGaussianSystem(information, vectors), inverse, variance
    )
    prior = reduced.information - information.sum(axis=0)  # exact: not inflated
    middle = np.tensordot(inflation, information, axes=1) + prior
    covariance = variance * inverse @ middle @ inverse
    full = np.zeros(equations.system.information.shape)
    full[np.ix_(rest, rest)] = 0.5 * (covariance + covariance.T)
    pairs = slice(0, equations.first_board)
    cameras = {
        name: full[np.ix_(columns, columns)]
        for name, columns in zip(equations.names, equations.camera_columns, strict=True)
        if len(columns)
    }
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
                max_displacement_mm(first, rig_from_board[target], size) < 0.05 * size
            ):
                cluster.append(target)
                break
        else:
            clusters.append([target])
    return clusters


def variance_inflations(
    clusters: LinearGaussianSystem, covariance: Array, variance: float
) -> tuple[Array, float]:
    """Estimate the variance inflation of each cluster, (K,), and over all clusters.

    clusters: the systems of K clusters at the solution, (K, P, P) and (K, P).
    covariance: V (P, P) of independent corners of unit variance.
    variance: of a corner's coordinate, px2.

    Of independent corners b^T V b / variance has the expectation tr(S - S S), S = H V being the
    cluster's share of all information: less than tr S because the solve followed the cluster. A
    cluster's own ratio counts for half at 10 degrees of freedom, the rest being that of all.
    """
    # One by one: with the corners of boards as unknowns all at once would take gigabytes.
    traces = []
    for information in clusters.information:
        share = information @ covariance
        kept = share - share @ share
        traces.append((np.trace(kept), np.sum(kept * kept.T)))
    expected, squared = np.array(traces).T
    freedoms = expected**2 / np.maximum(squared, 1e-300)
    vectors = clusters.vector
    found = np.einsum("ki,ij,kj->k", vectors, covariance, vectors) / variance
    if not expected.sum() > 1.0:  # a single cluster: its errors cannot be judged
        return np.ones(len(vectors)), 1.0
    pooled = max(float(found.sum() / expected.sum()), 1.0)
    single = found / np.maximum(expected, 1e-12)
    weight = freedoms / (freedoms + 10.0)
    mixed = weight * single + (1.0 - weight) * pooled
    return np.where(expected > 1e-6, mixed, pooled), pooled
