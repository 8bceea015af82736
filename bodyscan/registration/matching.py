"""Which points of two range images are the same spot of the subject.

`match_nearest` asks Open3D for the nearest point in space; `match_projected` looks into the other
camera's pixel grid, which needs no search and knows where that camera saw nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

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

    def thinned(self, step: int) -> Patch:
        """Every `step`th point; their order has nothing to do with where they lie."""
        some = slice(None, None, step)
        return replace(
            self,
            points=self.points[some],
            normals=self.normals[some],
            sigma_mm=self.sigma_mm[some],
            rim=self.rim[some],
        )


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
    rows, columns = np.nonzero(image.valid & np.isfinite(image.normals[..., 0]))
    points, normals = image.points[rows, columns], image.normals[rows, columns]
    facing = -_dot(points, normals) / np.maximum(_length(points), np.float32(1e-9))
    cells = np.floor(points.T * np.float32(1.0 / spacing_mm)).astype(np.int64)
    keys = (cells[0] * 73856093) ^ (cells[1] * 19349663) ^ (cells[2] * 83492791)
    usable = np.flatnonzero(facing > EDGE_ON)
    chosen = usable[np.unique(keys[usable], return_index=True)[1]]
    rows, columns = rows[chosen], columns[chosen]
    return Patch(
        image,
        inner,
        points[chosen].astype(np.float64),
        normals[chosen].astype(np.float64),
        (image.sigma_mm[rows, columns] * facing[chosen]).astype(np.float64),
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
    edge_on = -_dot(points, normals) < EDGE_ON * _length(points)
    index = np.flatnonzero(ahead & ~edge_on & ~source.rim)
    pixels = np.rint(image.camera.project(points[index])).astype(np.int64)
    inside = np.all((pixels >= 0) & (pixels < [image.camera.width, image.camera.height]), axis=1)
    index, (columns, rows) = index[inside], pixels[inside].T
    there = image.points[rows, columns].astype(np.float64)
    across = image.normals[rows, columns].astype(np.float64)
    mean = normals[index] + across
    mean /= np.maximum(_length(mean), 1e-9)[:, None]
    distance = _dot(points[index] - there, mean)
    same = target.inner[rows, columns] & (np.abs(distance) < reach_mm)
    same &= _dot(normals[index], across) > FACING
    facing = np.abs(_dot(points[index], across)) / _length(points[index])
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


def _dot(one: NDArray[Any], other: NDArray[Any]) -> NDArray[Any]:
    """(N,) of (N, 3) and (N, 3); numpy is slow at sums of three."""
    return np.einsum("nc,nc->n", one, other)


def _length(vectors: NDArray[Any]) -> NDArray[Any]:
    return np.sqrt(_dot(vectors, vectors))


def _cloud(points: Array) -> o3d.geometry.PointCloud:
    cloud = o3d.geometry.PointCloud()
    cloud.points = o3d.utility.Vector3dVector(points)
    return cloud
