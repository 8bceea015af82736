"""What the pairs' poses, and the following of a moving person, add to each point's sigma."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from bodyscan.alignment.following import Followed
from bodyscan.arrays import Array, Floats
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

    A small motion (w, t) of a pair moves a point p along its normal n by (p x n).w + n.t. The
    variance is the mean over the pairs that face the point: shared errors do not average out.
    """
    centres = np.array([placing.translation for placing in rig_from_camera.values()])
    covariances = np.array([prior.of(name) for name in rig_from_camera])
    placing_mm = np.empty(len(cloud.points))

    def fill(part: slice) -> None:
        _placing(cloud.points[part], cloud.normals[part], centres, covariances, placing_mm[part])

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
    centres: Array,
    covariances: Array,
    placing_mm: Array,
) -> None:
    """Write standard deviations (N,) mm along the normals due to pose errors.

    Pairs stand at `centres` (P, 3) with `covariances` (P, 6, 6).
    """
    lever = np.empty(6)
    for n in range(len(points)):
        (x, y, z), (a, b, c) = points[n], normals[n]
        lever[0], lever[1], lever[2] = y * c - z * b, z * a - x * c, x * b - y * a
        lever[3], lever[4], lever[5] = a, b, c
        total, count = 0.0, 0
        for pair in range(len(centres)):
            dx, dy, dz = centres[pair, 0] - x, centres[pair, 1] - y, centres[pair, 2] - z
            towards = a * dx + b * dy + c * dz
            if towards <= FACING * math.sqrt(dx * dx + dy * dy + dz * dz):
                continue
            count += 1
            for row in range(6):
                part = 0.5 * covariances[pair, row, row] * lever[row]
                for column in range(row + 1, 6):
                    part += covariances[pair, row, column] * lever[column]
                total += 2.0 * part * lever[row]
        placing_mm[n] = math.sqrt(total / max(count, 1))
