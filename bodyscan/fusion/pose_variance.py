"""What the pairs' poses, and the following of a moving person, add to each point's sigma."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from bodyscan.alignment.following import Followed
from bodyscan.arrays import Array, Bytes, Floats, Mask
from bodyscan.compiled import compiled
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.geometry.uncertainty import PoseCovariance
from bodyscan.mesh.body import BodyCloud
from bodyscan.progress import map_threads, split_range

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
    joint = prior.select(tuple(rig_from_camera)).reshape(size, 6, size, 6).swapaxes(1, 2)
    rows, columns = np.triu_indices(6)
    packed = joint[..., rows, columns] + np.where(rows < columns, joint[..., columns, rows], 0.0)
    placing_mm = np.empty(len(cloud.points))

    def fill(part: slice) -> None:
        surface = cloud.points[part], cloud.normals[part], cloud.pairs_seen[part]
        _placing(*surface, centres, packed, placing_mm[part])

    map_threads(fill, split_range(len(placing_mm)), stage="sigmas of places")
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

    Pairs stand at `centres` (P, 3). joint: their covariances (P, P, 21): of each two the upper
    triangle, with what lies below it added.
    """
    lever, products, facing = np.empty(6), np.empty(21), np.zeros(len(centres), np.bool_)
    own, between = np.zeros(21), np.zeros(21)
    for n in range(len(points)):
        (x, y, z), (a, b, c) = points[n], normals[n]
        lever[0], lever[1], lever[2] = y * c - z * b, z * a - x * c, x * b - y * a
        lever[3], lever[4], lever[5] = a, b, c
        k = 0
        for row in range(6):
            for column in range(row, 6):
                products[k] = lever[row] * lever[column]
                k += 1
        count, others = 0, False
        for pair in range(len(centres)):
            dx, dy, dz = centres[pair, 0] - x, centres[pair, 1] - y, centres[pair, 2] - z
            towards = a * dx + b * dy + c * dz
            faces = towards > FACING * math.sqrt(dx * dx + dy * dy + dz * dz)
            others |= faces != facing[pair]
            facing[pair] = faces
            count += faces
        if others:  # most points face the same pairs as the one before
            _sum_up(joint, facing, own, between)
        mean, shared = 0.0, 0.0
        for k in range(21):
            mean += own[k] * products[k] / max(count, 1)
            shared += between[k] * products[k] / max(count * (count - 1) / 2, 1.0)
        alone = 1.0 / max(min(pairs_seen[n], count), 1)
        placing_mm[n] = math.sqrt(max(alone * mean + (1.0 - alone) * shared, 0.0))


@compiled
def _sum_up(joint: Array, facing: Mask, own: Array, between: Array) -> None:
    """Write the sums of the facing pairs' own covariances, and of those of each two of them."""
    own[:], between[:] = 0.0, 0.0
    for i in range(len(facing)):
        if not facing[i]:
            continue
        for k in range(21):
            own[k] += joint[i, i, k]
        for j in range(i):
            if facing[j]:
                for k in range(21):
                    between[k] += joint[i, j, k]
