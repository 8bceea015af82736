"""Registration by Open3D: ICP of every two range images from coarse to fine, then a pose graph.

ICP is point to plane with a robust kernel. The graph has a node for each pair and one for the rig.
Edges between pairs are weighted by what their overlap determines along its normals (Open3D's own
matrices count points, as if these held in every direction); edges from the rig by what the boards
and the subject's sway allow. Such a graph has no place for the boards' covariance between pairs,
which `icp` does use.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import open3d as o3d

from bodyscan.alignment.matching import FACING, AlignmentPoints, Matches
from bodyscan.alignment.overlap_equations import OverlapEquations
from bodyscan.alignment.overlaps import COARSE
from bodyscan.alignment.sway_prior import SwayPrior
from bodyscan.arrays import Array
from bodyscan.geometry.linear_gaussian import solve_scaled
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.geometry.uncertainty import PoseCovariance
from bodyscan.settings import AlignmentSettings

registration = o3d.pipelines.registration

STEPS = 15
"""Most iterations of ICP with one reach."""
KERNEL = 0.15
"""As a share of the reach: distances beyond it count for less, 0.5 mm at the last reach."""
SWAYS = 3
"""Number of times the graph is solved, each with the sway that the last solution found."""
DIGITS = 9
"""Decimals of motions, radians and mm: Open3D's threads sum in any order."""
RIG = 0
"""The graph's fixed node; pairs follow in their order."""


def register(
    clouds: Sequence[AlignmentPoints],
    rig_from_camera: Sequence[RigidTransform],
    names: Sequence[str],
    prior: PoseCovariance,
    settings: AlignmentSettings,
) -> Array:
    """Motions (P, 6) of the pairs, rig frame, that bring their overlaps together."""
    both = list(zip(clouds, rig_from_camera, strict=True))
    fine = [_Placed.of(seen, at) for seen, at in both]
    coarse = [_Placed.of(seen.some(COARSE), at) for seen, at in both]
    sway, scale = SwayPrior.of(settings), 1.0
    widest = PoseCovariance(tuple(names), sway.covariance(names, prior, sway.most))
    edges: dict[tuple[int, int], _Edge] = {}
    for i, j in combinations(range(len(both)), 2):
        edge = _bring_together((coarse[i], coarse[j]), (fine[i], fine[j]), settings)
        if edge and edge.sigmas(widest.relative(names[j], names[i])) < settings.limit_sigmas:
            edges[i, j] = edge
    motions = np.zeros((len(both), 6))
    for _ in range(SWAYS):
        motions = _solve_graph(edges, sway.covariance(names, prior, scale))
        scale = sway.scale(motions)
    return np.round(motions, DIGITS)


@dataclass(frozen=True, eq=False)
class _Placed:
    """Inner points of a range image as Open3D's cloud, rig frame, with their sigmas, mm."""

    cloud: o3d.geometry.PointCloud
    sigma_mm: Array

    @staticmethod
    def of(seen: AlignmentPoints, rig_from_camera: RigidTransform) -> _Placed:
        own = ~seen.rim
        cloud = o3d.geometry.PointCloud()
        cloud.points = o3d.utility.Vector3dVector(rig_from_camera.apply(seen.points[own]))
        cloud.normals = o3d.utility.Vector3dVector(rig_from_camera.rotate(seen.normals[own]))
        return _Placed(cloud, seen.sigma_mm[own])


@dataclass(frozen=True, eq=False)
class _Edge:
    """motion: (4, 4), brings the source onto the target.  information: (6, 6) on its rotation and
    translation."""

    motion: Array
    information: Array

    def sigmas(self, covariance: Array) -> float:
        """How far the source was moved, in sigmas of such a covariance (6, 6).

        If two share only a rim, ICP slides along it.
        """
        twist = RigidTransform.from_matrix(self.motion).twist
        return float(np.sqrt(twist @ solve_scaled(covariance, twist) / 6.0))


def _bring_together(
    coarse: tuple[_Placed, _Placed], fine: tuple[_Placed, _Placed], settings: AlignmentSettings
) -> _Edge | None:
    """ICP of source and target with a reach halved each time; None if they share too little."""
    motion, reach = np.eye(4), settings.reach_mm
    steps = registration.ICPConvergenceCriteria(max_iteration=STEPS)
    while True:
        source, target = fine if reach <= settings.least_reach_mm else coarse
        kernel = registration.CauchyLoss(KERNEL * reach)
        estimation = registration.TransformationEstimationPointToPlane(kernel)
        found = registration.registration_icp(
            source.cloud, target.cloud, reach, motion, estimation, steps
        )
        if len(found.correspondence_set) < settings.fewest / COARSE.step:
            return None
        motion = found.transformation
        if reach <= settings.least_reach_mm:
            break
        reach = max(reach / 2.0, settings.least_reach_mm)
    matches = _matches(source, target, found)
    if len(matches.distances) < settings.fewest:
        return None
    return _Edge(motion, OverlapEquations.of(matches, settings.correlated).information)


def _matches(
    source: _Placed, target: _Placed, found: o3d.pipelines.registration.RegistrationResult
) -> Matches:
    """The last matches of ICP, restricted to spots that face alike."""
    pairs = np.asarray(found.correspondence_set).reshape(-1, 2)
    i, j = pairs[np.argsort(pairs[:, 0])].T  # Open3D's threads leave them in any order
    onto = RigidTransform.from_matrix(found.transformation)
    points = onto.apply(np.asarray(source.cloud.points)[i])
    normals = onto.rotate(np.asarray(source.cloud.normals)[i])
    across, there = np.asarray(target.cloud.normals)[j], np.asarray(target.cloud.points)[j]
    alike = np.sum(normals * across, axis=1) > FACING
    distances = np.sum((points - there) * across, axis=1)
    sigma_mm = np.hypot(source.sigma_mm[i], target.sigma_mm[j])
    return Matches(points[alike], across[alike], distances[alike], sigma_mm[alike], i[alike])


def _solve_graph(edges: Mapping[tuple[int, int], _Edge], covariance: Array) -> Array:
    """Motions (P, 6) of the pairs' nodes; covariance: their prior, (6P, 6P)."""
    graph = registration.PoseGraph()
    count = len(covariance) // 6
    graph.nodes.extend(registration.PoseGraphNode(np.eye(4)) for _ in range(count + 1))
    for k in range(count):
        own = covariance[6 * k : 6 * k + 6, 6 * k : 6 * k + 6]
        graph.edges.append(
            registration.PoseGraphEdge(k + 1, RIG, np.eye(4), np.linalg.inv(own), uncertain=False)
        )
    for (i, j), edge in edges.items():
        graph.edges.append(
            registration.PoseGraphEdge(i + 1, j + 1, edge.motion, edge.information, uncertain=False)
        )
    registration.global_optimization(
        graph,
        registration.GlobalOptimizationLevenbergMarquardt(),
        registration.GlobalOptimizationConvergenceCriteria(),
        registration.GlobalOptimizationOption(reference_node=RIG),
    )
    poses = [RigidTransform.from_matrix(node.pose) for node in graph.nodes]
    fixed = poses[RIG].inverse()
    return np.array([(fixed @ pose).twist for pose in poses[1:]])
