"""What the pairs' poses, and the following of a moving person, add to each point's sigma."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from bodyscan.alignment.following import Followed
from bodyscan.arrays import Array, Bytes, Floats
from bodyscan.compiled import compiled
from bodyscan.geometry.pose_covariance import PoseCovariance
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.mesh.body import BodyCloud
from bodyscan.progress import parts, threaded

FACING = 0.2
"""Cosine below which a pair sees a surface too flat to have measured it."""


def add_pose_variance(
    cloud: BodyCloud,
    rig_from_camera: Mapping[str, RigidTransform],
    prior: PoseCovariance,
) -> BodyCloud:
    """The cloud with the pairs' pose errors included in its sigmas along the normals.

    A small motion (w, t) of a pair moves a point p along its normal n by (p x n).w + n.t. A point
    is the mean of as many pairs as saw it, of those that face it: what is each pair's own averages
    out, what they share does not.
    """
    centres = np.array([placing.translation for placing in rig_from_camera.values()])
    size = len(centres)
    joint = prior.among(tuple(rig_from_camera)).reshape(size, 6, size, 6).swapaxes(1, 2).copy()
    placing_mm = np.empty(len(cloud.points))

    def fill(part: slice) -> None:
        surface = cloud.points[part], cloud.normals[part], cloud.pairs_seen[part]
        _placing(*surface, centres, joint, placing_mm[part])

    threaded(fill, parts(len(placing_mm)), stage="sigmas of places")
    return replace(cloud, sigma_mm=np.hypot(cloud.sigma_mm, placing_mm).astype(np.float32))


def add_motion_variance(cloud: BodyCloud, placed: BodyCloud, followed: Followed) -> BodyCloud:
    """The cloud with the uncertainty of the person's motion included in its sigmas.

    placed: the cloud with the pairs' pose errors, as known from the boards, in its sigmas.
        Following leaves out motions of the body as a whole, which these include: the larger of both
            counts.
    """
    cell = followed.cells.find_many(cloud.points, cloud.normals.astype(np.float64))
    sigma_mm = np.hypot(cloud.sigma_mm, followed.sigma_mm[cell])
    return replace(cloud, sigma_mm=np.maximum(sigma_mm, placed.sigma_mm).astype(np.float32))


@compiled
def _placing(
    points: Array,
    normals: Floats,
    pairs_seen: Bytes,
    centres: Array,
    joint: Array,
    placing_mm: Array,
) -> None:
    """Write standard deviations (N,) mm along the normals due to pose errors.

    Pairs stand at `centres` (P, 3) with covariances `joint` (P, P, 6, 6).
    """
    lever, facing = np.empty(6), np.empty(len(centres), np.int64)
    for n in range(len(points)):
        (x, y, z), (a, b, c) = points[n], normals[n]
        lever[0], lever[1], lever[2] = y * c - z * b, z * a - x * c, x * b - y * a
        lever[3], lever[4], lever[5] = a, b, c
        own, shared, count = 0.0, 0.0, 0
        for pair in range(len(centres)):
            dx, dy, dz = centres[pair, 0] - x, centres[pair, 1] - y, centres[pair, 2] - z
            towards = a * dx + b * dy + c * dz
            if towards <= FACING * math.sqrt(dx * dx + dy * dy + dz * dz):
                continue
            own += _along(lever, joint[pair, pair])
            for k in range(count):
                shared += _along(lever, joint[pair, facing[k]])
            facing[count] = pair
            count += 1
        if count == 0:
            placing_mm[n] = 0.0
            continue
        own /= count
        shared = 2.0 * shared / (count * (count - 1)) if count > 1 else own
        alone = 1.0 / max(min(pairs_seen[n], count), 1)
        placing_mm[n] = math.sqrt(max(alone * own + (1.0 - alone) * shared, 0.0))


@compiled
def _along(lever: Array, covariance: Array) -> float:
    """Covariance mm^2 along the normal whose `lever` (6,) it is."""
    total = 0.0
    for row in range(6):
        part = 0.0
        for column in range(6):
            part += covariance[row, column] * lever[column]
        total += part * lever[row]
    return total
