"""Which points of two range images are the same spot of the subject.

`match_nearest` asks Open3D for the nearest point in space; `match_projected` looks into the other
camera's pixel grid, which needs no search and knows where that camera saw nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from bodyscan.geometry.transforms import RigidTransform
from bodyscan.reconstruction.range_image import RangeImage

Array = NDArray[np.float64]

FACING = 0.7  # least cosine between the normals of what may be one spot
EDGE_ON = 0.3  # least cosine between a normal and the viewing ray
RIM_PX = 4


@dataclass(frozen=True, eq=False)
class Patch:
    """What takes part in alignment of one range image, camera frame: N points with normals, standard
    deviations along the normal, and whether they lie at the rim of what was measured.

    inner: (height, width), pixels away from the rim.  At silhouettes blur mixes a surface with
    its brighter, better facing parts, which lifts it by a few tenths of a millimetre.
    """

    image: RangeImage
    inner: NDArray[np.bool_]
    points: Array
    normals: Array
    sigma_mm: Array
    rim: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Matches:
    """M spots seen twice, rig frame: points (M, 3) of the source, normals (M, 3), distances (M,) mm
    from the target's surface to the source along the normal, their expected sigmas (M,) mm.
    """

    points: Array
    normals: Array
    distances: Array
    sigma_mm: Array


def patch(image: RangeImage, spacing_mm: float) -> Patch:
    """About evenly spread points of a range image; surfaces seen edge-on do not take part."""
    window = np.ones((2 * RIM_PX + 1, 2 * RIM_PX + 1), np.uint8)
    inner = cv2.erode(image.valid.astype(np.uint8), window) > 0
    facing = -np.sum(image.points * image.normals, axis=-1) / np.maximum(
        np.linalg.norm(image.points, axis=-1), 1e-9
    )
    usable = image.valid & np.isfinite(image.normals[..., 0]) & (facing > EDGE_ON)
    rows, columns = np.nonzero(usable)
    points = image.points[rows, columns].astype(np.float64)
    cells = np.floor(points / spacing_mm).astype(np.int64)
    keys = (cells[:, 0] * 73856093) ^ (cells[:, 1] * 19349663) ^ (cells[:, 2] * 83492791)
    _, first = np.unique(keys, return_index=True)
    rows, columns = rows[first], columns[first]
    return Patch(
        image,
        inner,
        image.points[rows, columns].astype(np.float64),
        image.normals[rows, columns].astype(np.float64),
        (image.sigma_mm * facing)[rows, columns].astype(np.float64),
        ~inner[rows, columns],
    )


def match_projected(
    source: Patch,
    target: Patch,
    rig_from_source: RigidTransform,
    rig_from_target: RigidTransform,
    reach_mm: float,
) -> Matches:
    """Each source point against the surface that the target camera saw in its direction."""
    image = target.image
    target_from_source = rig_from_target.inverse() @ rig_from_source
    points = target_from_source.apply(source.points)
    normals = target_from_source.rotate(source.normals)
    ahead = points[:, 2] > 100.0
    edge_on = -np.sum(points * normals, axis=1) < EDGE_ON * np.linalg.norm(points, axis=1)
    index = np.flatnonzero(ahead & ~edge_on & ~source.rim)
    pixels = np.rint(image.camera.project(points[index])).astype(np.int64)
    inside = np.all((pixels >= 0) & (pixels < [image.camera.width, image.camera.height]), axis=1)
    index, (columns, rows) = index[inside], pixels[inside].T
    there = image.points[rows, columns].astype(np.float64)
    across = image.normals[rows, columns].astype(np.float64)
    mean = normals[index] + across
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-9)
    distance = np.sum((points[index] - there) * mean, axis=1)
    same = target.inner[rows, columns] & (np.abs(distance) < reach_mm)
    same &= np.sum(normals[index] * across, axis=1) > FACING
    ray = points[index] / np.linalg.norm(points[index], axis=1, keepdims=True)
    facing = np.abs(np.sum(ray * across, axis=1))
    sigma = np.hypot(source.sigma_mm[index], image.sigma_mm[rows, columns] * facing)
    return Matches(
        rig_from_target.apply(points[index][same]),
        rig_from_target.rotate(mean[same]),
        distance[same],
        sigma[same],
    )


def match_nearest(
    source: Patch,
    target: Patch,
    rig_from_source: RigidTransform,
    rig_from_target: RigidTransform,
    reach_mm: float,
) -> Matches:
    """Each source point against the nearest target point (Open3D), unless that lies at a rim.

    Distances are taken along the mean of both normals, which on a curved surface is right to second
    order where a single normal is not (Rusinkiewicz, A Symmetric Objective Function for ICP, 2019).
    """
    points, normals = rig_from_source.apply(source.points), rig_from_source.rotate(source.normals)
    there, across = rig_from_target.apply(target.points), rig_from_target.rotate(target.normals)
    found = o3d.pipelines.registration.evaluate_registration(
        _cloud(points), _cloud(there), reach_mm
    )
    pairs = np.asarray(found.correspondence_set).reshape(-1, 2)
    i, j = pairs[:, 0], pairs[:, 1]
    same = ~source.rim[i] & ~target.rim[j] & (np.sum(normals[i] * across[j], axis=1) > FACING)
    i, j = i[same], j[same]
    mean = normals[i] + across[j]
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-9)
    distance = np.sum((points[i] - there[j]) * mean, axis=1)
    return Matches(points[i], mean, distance, np.hypot(source.sigma_mm[i], target.sigma_mm[j]))


def _cloud(points: Array) -> o3d.geometry.PointCloud:
    cloud = o3d.geometry.PointCloud()
    cloud.points = o3d.utility.Vector3dVector(points)
    return cloud
