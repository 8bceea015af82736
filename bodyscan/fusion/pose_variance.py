"""Add the uncertainty of the pairs' poses, and of a person's motion, to the points' sigmas."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise

import numpy as np
from scipy.spatial.distance import cdist

from bodyscan.arrays import Array, Bytes
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.geometry.uncertainty import PoseCovariance
from bodyscan.mesh.body import BodyCloud
from bodyscan.motion.estimation import EstimatedMotion
from bodyscan.progress import map_threads


def add_pose_variance(
    cloud: BodyCloud, rig_from_camera: Mapping[str, RigidTransform], prior: PoseCovariance
) -> BodyCloud:
    """Add the variance of the pairs' poses along the normals to a cloud's sigmas.

    A small motion (w, t) of a pair moves a point p along its normal n by (p x n).w + n.t. In the
    mean of `pairs_seen` pairs independent errors average out, covariances do not.
    """
    centres = np.array([pose.translation for pose in rig_from_camera.values()])
    size = len(centres)
    joint = prior.select(tuple(rig_from_camera)).reshape(size, 6, size, 6)

    def variance(some: slice) -> Array:
        points, normals = cloud.points[some], cloud.normals[some].astype(np.float64)
        return _point_variance(points, normals, cloud.pairs_seen[some], centres, joint)

    # As many parts whatever the threads: the same bytes.
    ends = np.linspace(0, len(cloud.points), 5).astype(int)
    parts = map_threads(variance, [slice(*both) for both in pairwise(ends.tolist())])
    added = np.sqrt(cloud.sigma_mm**2 + np.concatenate(parts))
    return replace(cloud, sigma_mm=added.astype(np.float32))


def _point_variance(
    points: Array, normals: Array, pairs_seen: Bytes, centres: Array, joint: Array
) -> Array:
    """Variance (N,) mm^2 along normals of points (N, 3), each the mean of `pairs_seen` pairs' (N,).

    centres: (P, 3) of the cameras. joint: (P, 6, P, 6), covariance of the pairs' twists.
    """
    towards = normals @ centres.T - np.sum(points * normals, axis=1)[:, None]
    facing = towards > 0.2 * cdist(points, centres)
    lever = np.hstack([np.cross(points, normals), normals])
    variance = np.zeros(len(points))
    # Many points face the same pairs; bytes hold any number of these.
    bits = np.packbits(facing, axis=1)
    order = np.lexsort(bits.T)
    starts = np.flatnonzero(np.diff(bits[order].astype(np.int16), axis=0).any(axis=1)) + 1
    for group in np.split(order, starts):
        if len(group):
            pairs = np.flatnonzero(facing[group[0]])
            used = np.minimum(pairs_seen[group], len(pairs))
            variance[group] = _compute_mean_variance(lever[group], joint[pairs][:, :, pairs], used)
    return variance


def _compute_mean_variance(lever: Array, joint: Array, used: Bytes) -> Array:
    """Variance (N,) of the mean of some pairs' offsets along normals, `used` (N,) for each point.

    lever: (N, 6), derivative of an offset by a pair's twist. joint: (P, 6, P, 6), covariance of the
        twists of the pairs that the points face.
    """
    count = len(joint)
    alone = np.einsum("pipj->ij", joint)
    between = joint.sum(axis=(0, 2)) - alone
    share = 1.0 / np.clip(used, 1, None)
    mean = share * np.sum(lever @ alone * lever, axis=1) / max(count, 1)
    mean += (1.0 - share) * np.sum(lever @ between * lever, axis=1) / max(count * (count - 1), 1)
    return np.maximum(mean, 0.0)


def add_motion_variance(
    cloud: BodyCloud, with_poses: BodyCloud, followed: EstimatedMotion
) -> BodyCloud:
    """Add the variance of the person's motion to a cloud's sigmas.

    Following leaves out motions of the body as a whole, which the sigmas of `with_poses` (from
    `add_pose_variance`) include: the larger of both counts.
    """
    cell = followed.cells.find_by_groups(cloud.points, cloud.normals.astype(np.float64))
    sigma_mm = np.hypot(cloud.sigma_mm, followed.sigma_mm[cell])
    return replace(cloud, sigma_mm=np.maximum(sigma_mm, with_poses.sigma_mm).astype(np.float32))
