"""Add the uncertainty of the pairs' poses, and of a person's motion, to the points' sigmas."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy.spatial.distance import cdist

from bodyscan.arrays import Array
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

    def compute(part: slice) -> Array:
        points, normals = cloud.points[part], cloud.normals[part].astype(np.float64)
        towards = normals @ centres.T - np.sum(points * normals, axis=1)[:, None]
        facing = towards > 0.2 * cdist(points, centres)
        groups, group = np.unique(facing, axis=0, return_inverse=True)  # the same pairs for many
        shares = groups.astype(np.float64)
        alone = np.einsum("gp,piqj,pq->gij", shares, joint, np.eye(size))
        between = np.einsum("gp,gq,piqj->gij", shares, shares, joint, optimize=True) - alone
        lever = np.hstack([np.cross(points, normals), normals])
        variance, covariance = (
            np.einsum("ni,nij,nj->n", lever, matrices[group.ravel()], lever)
            for matrices in (alone, between)
        )
        count = facing.sum(axis=1)
        share = 1.0 / np.clip(np.minimum(cloud.pairs_seen[part], count), 1, None)
        mean = share * variance / np.maximum(count, 1)
        mean += (1.0 - share) * covariance / np.maximum(count * (count - 1), 1)
        return np.asarray(np.maximum(mean, 0.0))

    block = 1 << 16  # points whose matrices fit into some tens of megabytes
    parts = [slice(start, start + block) for start in range(0, len(cloud.points), block)]
    variance = np.concatenate(map_threads(compute, parts, stage="sigmas of poses"))
    sigma_mm = np.sqrt(cloud.sigma_mm**2 + variance).astype(np.float32)
    return replace(cloud, sigma_mm=sigma_mm)


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
