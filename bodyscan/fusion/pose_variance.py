"""Add the uncertainty of the pairs' poses, and of a person's motion, to the points' sigmas."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from bodyscan.arrays import Array, Bytes, Floats, Mask
from bodyscan.compiled import compiled
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.geometry.uncertainty import PoseCovariance
from bodyscan.mesh.body import BodyCloud
from bodyscan.motion.estimation import EstimatedMotion
from bodyscan.progress import map_threads, split_range


def add_pose_variance(
    cloud: BodyCloud, rig_from_camera: Mapping[str, RigidTransform], prior: PoseCovariance
) -> BodyCloud:
    """Add the variance of the pairs' poses along the normals to a cloud's sigmas.

    A small motion (w, t) of a pair moves a point p along its normal n by (p x n).w + n.t. In the
    mean of `pairs_seen` pairs independent errors average out, covariances do not.
    """
    centres = np.array([pose.translation for pose in rig_from_camera.values()])
    size = len(centres)
    joint = prior.select(tuple(rig_from_camera)).reshape(size, 6, size, 6).swapaxes(1, 2)
    rows, columns = np.triu_indices(6)
    packed = joint[..., rows, columns] + np.where(rows < columns, joint[..., columns, rows], 0.0)
    sigma_mm = np.empty(len(cloud.points))

    def fill(part: slice) -> None:
        surface = cloud.points[part], cloud.normals[part], cloud.pairs_seen[part]
        _pose_sigmas(*surface, centres, packed, sigma_mm[part])

    map_threads(fill, split_range(len(sigma_mm)), stage="sigmas of poses")
    return replace(cloud, sigma_mm=np.hypot(cloud.sigma_mm, sigma_mm).astype(np.float32))


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


@compiled
def _pose_sigmas(
    points: Array, normals: Floats, pairs_seen: Bytes, centres: Array, joint: Array, sigma_mm: Array
) -> None:
    """Write standard deviations (N,) mm along the normals due to errors of pairs at `centres` (P,
    3).

    joint: their covariances (P, P, 21), the upper triangle with what lies below it added.
    """
    lever, products, facing = np.empty(6), np.empty(21), np.zeros(len(centres), np.bool_)
    alone, between = np.zeros(21), np.zeros(21)
    for n in range(len(points)):
        (x, y, z), (a, b, c) = points[n], normals[n]
        lever[0], lever[1], lever[2] = y * c - z * b, z * a - x * c, x * b - y * a
        lever[3], lever[4], lever[5] = a, b, c
        k = 0
        for row in range(6):
            for column in range(row, 6):
                products[k] = lever[row] * lever[column]
                k += 1
        count, changed = 0, False
        for pair in range(len(centres)):
            dx, dy, dz = centres[pair, 0] - x, centres[pair, 1] - y, centres[pair, 2] - z
            towards = a * dx + b * dy + c * dz
            faces = towards > 0.2 * math.sqrt(dx * dx + dy * dy + dz * dz)
            changed |= faces != facing[pair]
            facing[pair] = faces
            count += faces
        if changed:  # most points face the same pairs as the one before
            _sum_covariances(joint, facing, alone, between)
        variance, covariance = 0.0, 0.0
        for k in range(21):
            variance += alone[k] * products[k] / max(count, 1)
            covariance += between[k] * products[k] / max(count * (count - 1) / 2, 1.0)
        share = 1.0 / max(min(pairs_seen[n], count), 1)
        sigma_mm[n] = math.sqrt(max(share * variance + (1.0 - share) * covariance, 0.0))


@compiled
def _sum_covariances(joint: Array, facing: Mask, alone: Array, between: Array) -> None:
    """Write the sums of the facing pairs' covariances, and of those of each two of them."""
    alone[:], between[:] = 0.0, 0.0
    for i in range(len(facing)):
        if not facing[i]:
            continue
        for k in range(21):
            alone[k] += joint[i, i, k]
        for j in range(i):
            if facing[j]:
                for k in range(21):
                    between[k] += joint[i, j, k]
