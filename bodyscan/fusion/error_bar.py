"""What a point's error bar owes to the rig: how well the pairs that see it are placed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bodyscan.fusion.body import BodyCloud
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.registration.uncertainty import PlacingCovariance

Array = NDArray[np.float64]

FACING = 0.2
"""Cosine below which a pair sees a surface too flat to have measured it."""


def with_placing(
    cloud: BodyCloud, rig_from_camera: Mapping[str, RigidTransform], prior: PlacingCovariance
) -> BodyCloud:
    """The cloud with sigmas along the normals that hold the pairs' placing too.

    A small motion (w, t) of a pair moves a point p along its normal n by (p x n).w + n.t. The
    variance is the mean over the pairs that face the point: what they share does not average out.
    """
    points, normals = cloud.points, cloud.normals.astype(np.float64)
    lever = np.concatenate([np.cross(points, normals), normals], axis=1)
    total, count = np.zeros(len(points)), np.zeros(len(points))
    for name, placing in rig_from_camera.items():
        towards = placing.translation - points
        dots = np.einsum("nc,nc->n", normals, towards)
        faces = dots > FACING * np.sqrt(np.einsum("nc,nc->n", towards, towards))
        own = lever[faces]
        total[faces] += np.einsum("nc,nc->n", own @ prior.of(name), own)
        count += faces
    placing_mm = np.sqrt(total / np.maximum(count, 1.0))
    return replace(cloud, sigma_mm=np.hypot(cloud.sigma_mm, placing_mm).astype(np.float32))
