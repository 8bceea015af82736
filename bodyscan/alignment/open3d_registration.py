"""Registration with Open3D: point-to-plane ICP of every two range images, then a pose graph.

The graph has a node for each pair and one for the rig. Edges between pairs carry the information of
the overlap's point-to-plane equations (Open3D's own matrices count points, as if these constrained
every direction); edges from the rig that of calibration and sway. Such a graph cannot hold the
calibration's covariance between pairs, which `icp` uses.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import open3d as o3d

from bodyscan.alignment.matching import MIN_NORMAL_COSINE, Matches, SampledPoints
from bodyscan.alignment.overlaps import COARSE, linearize
from bodyscan.alignment.sway_prior import SwayPrior
from bodyscan.arrays import Array
from bodyscan.geometry.linear_gaussian import solve_scaled
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.geometry.uncertainty import PoseCovariance
from bodyscan.settings import AlignmentSettings

registration = o3d.pipelines.registration


def register(
    clouds: Sequence[SampledPoints],
    rig_from_camera: Sequence[RigidTransform],
    names: Sequence[str],
    prior: PoseCovariance,
    settings: AlignmentSettings,
) -> Array:
    """Estimate the twists (P, 6) of the pairs, rig frame, that align their overlaps."""
    both = list(zip(clouds, rig_from_camera, strict=True))
    fine = [_RigCloud.from_points(cloud, pose) for cloud, pose in both]
    coarse = [_RigCloud.from_points(cloud.select(COARSE), pose) for cloud, pose in both]
    sway, scale = SwayPrior.from_settings(settings), 1.0
    widest = PoseCovariance(tuple(names), sway.covariance(names, prior, sway.max_scale))
    edges: dict[tuple[int, int], _Edge] = {}
    for i, j in combinations(range(len(both)), 2):
        edge = _register_two((coarse[i], coarse[j]), (fine[i], fine[j]), settings)
        if edge and edge.sigmas(widest.relative(names[j], names[i])) < settings.limit_sigmas:
            edges[i, j] = edge
    motions = np.zeros((len(both), 6))
    for _ in range(3):  # each with the sway that the last solution found
        motions = _solve_graph(edges, sway.covariance(names, prior, scale))
        scale = sway.scale(motions)
    # Open3D's threads sum in any order, which shows at 1e-11; a micrometre at a metre is nothing.
    return np.round(motions, 6)


@dataclass(frozen=True, eq=False)
class _RigCloud:
    """Inner points of a range image as Open3D's cloud, rig frame, with their sigmas, mm."""

    cloud: o3d.geometry.PointCloud
    sigma_mm: Array

    @staticmethod
    def from_points(points: SampledPoints, rig_from_camera: RigidTransform) -> _RigCloud:
        inner = ~points.in_margin
        cloud = o3d.geometry.PointCloud()
        cloud.points = o3d.utility.Vector3dVector(rig_from_camera.apply(points.points[inner]))
        cloud.normals = o3d.utility.Vector3dVector(rig_from_camera.rotate(points.normals[inner]))
        return _RigCloud(cloud, points.sigma_mm[inner])


@dataclass(frozen=True, eq=False)
class _Edge:
    """motion: (4, 4), aligns the source with the target.  information: (6, 6), on its twist."""

    motion: Array
    information: Array

    def sigmas(self, covariance: Array) -> float:
        """Mahalanobis length of the motion for a covariance (6, 6), over the root of 6. Where two share
        only a strip, ICP slides along it."""
        twist = RigidTransform.from_matrix(self.motion).twist
        return float(np.sqrt(twist @ solve_scaled(covariance, twist) / 6.0))


def _register_two(
    coarse: tuple[_RigCloud, _RigCloud],
    fine: tuple[_RigCloud, _RigCloud],
    settings: AlignmentSettings,
) -> _Edge | None:
    """Register two clouds with a reach halved each time; None if they share too few points."""
    motion, reach = np.eye(4), settings.reach_mm
    criteria = registration.ICPConvergenceCriteria(max_iteration=15)
    while True:
        source, target = fine if reach <= settings.min_reach_mm else coarse
        kernel = registration.CauchyLoss(0.15 * reach)  # 0.5 mm at the last reach
        estimation = registration.TransformationEstimationPointToPlane(kernel)
        found = registration.registration_icp(
            source.cloud, target.cloud, reach, motion, estimation, criteria
        )
        if len(found.correspondence_set) < settings.min_matches / COARSE.step:
            return None
        motion = found.transformation
        if reach <= settings.min_reach_mm:
            break
        reach = max(reach / 2.0, settings.min_reach_mm)
    matches = _select_matches(source, target, found)
    if len(matches.distances) < settings.min_matches:
        return None
    return _Edge(motion, linearize(matches, settings.correlated).information)


def _select_matches(
    source: _RigCloud, target: _RigCloud, found: o3d.pipelines.registration.RegistrationResult
) -> Matches:
    """The last matches of ICP whose normals agree."""
    pairs = np.asarray(found.correspondence_set).reshape(-1, 2)
    i, j = pairs[np.argsort(pairs[:, 0])].T  # Open3D's threads leave them in any order
    onto = RigidTransform.from_matrix(found.transformation)
    points = onto.apply(np.asarray(source.cloud.points)[i])
    normals = onto.rotate(np.asarray(source.cloud.normals)[i])
    target_normals, target_points = (
        np.asarray(values)[j] for values in (target.cloud.normals, target.cloud.points)
    )
    agree = np.sum(normals * target_normals, axis=1) > MIN_NORMAL_COSINE
    distances = np.sum((points - target_points) * target_normals, axis=1)
    sigma_mm = np.hypot(source.sigma_mm[i], target.sigma_mm[j])
    return Matches(
        points[agree], target_normals[agree], distances[agree], sigma_mm[agree], i[agree]
    )


def _solve_graph(edges: Mapping[tuple[int, int], _Edge], covariance: Array) -> Array:
    """Twists (P, 6) of the pairs' nodes; covariance: their prior, (6P, 6P). Node 0 is the rig, fixed;
    the pairs follow in their order."""
    graph = registration.PoseGraph()
    count = len(covariance) // 6
    graph.nodes.extend(registration.PoseGraphNode(np.eye(4)) for _ in range(count + 1))
    for k in range(count):
        block = covariance[6 * k : 6 * k + 6, 6 * k : 6 * k + 6]
        graph.edges.append(
            registration.PoseGraphEdge(k + 1, 0, np.eye(4), np.linalg.inv(block), uncertain=False)
        )
    for (i, j), edge in edges.items():
        graph.edges.append(
            registration.PoseGraphEdge(i + 1, j + 1, edge.motion, edge.information, uncertain=False)
        )
    registration.global_optimization(
        graph,
        registration.GlobalOptimizationLevenbergMarquardt(),
        registration.GlobalOptimizationConvergenceCriteria(),
        registration.GlobalOptimizationOption(reference_node=0),
    )
    poses = [RigidTransform.from_matrix(node.pose) for node in graph.nodes]
    rig_from_graph = poses[0].inverse()
    return np.array([(rig_from_graph @ pose).twist for pose in poses[1:]])
