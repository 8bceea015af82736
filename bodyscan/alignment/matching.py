"""Match points of two range images by projective data association.

Each point is projected into the other camera's pixel grid (Blais and Levine 1995): no search tree,
and it shows where that camera measured nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from bodyscan.arrays import Array, Floats, Indices, Mask
from bodyscan.compiled import compiled
from bodyscan.geometry.camera_tables import Table, look_up, make_projection_table
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.reconstruction.range_image import RangeImage

Vector = tuple[float, float, float]

MIN_NORMAL_COSINE = 0.7  # between the two normals of a match
MIN_VIEW_COSINE = 0.3  # between a normal and the viewing ray
NARROW_MARGIN_PX = 2  # blur reaches less far than this; only its bias remains


@dataclass(frozen=True, eq=False)
class SampledPoints:
    """N points of one range image that are matched with other images, camera frame."""

    image: RangeImage
    # Pixels away from the margin of what was measured, (h, w). At silhouettes blur mixes in the
    # brighter parts that face the camera, which lifts a surface by some tenths of a millimetre.
    inner: Mask
    # points, normals: (N, 3).
    points: Array
    normals: Array
    sigma_mm: Array  # standard deviations along the normals, (N,)
    in_margin: Mask  # whether a point lies in that margin, (N,)

    def select(self, chosen: Mask | slice) -> SampledPoints:
        """Copy the chosen points."""
        names = "points", "normals", "sigma_mm", "in_margin"
        return replace(self, **{name: getattr(self, name)[chosen].copy() for name in names})


@dataclass(frozen=True, eq=False)
class Matches:
    """M points of a source image matched with a target's surface, rig frame."""

    points: Array  # of the source, (M, 3) mm
    normals: Array  # mean normals of both surfaces, (M, 3)
    distances: Array  # from the target's surface to the source point along the normal, (M,) mm
    sigma_mm: Array  # expected standard deviations of the distances, (M,)
    source: Indices  # indices of the source's points, (M,)


def sample_points(
    image: RangeImage, spacing_mm: float, margins_px: Sequence[int] = (4,)
) -> tuple[SampledPoints, ...]:
    """Sample every n-th row and column, `spacing_mm` apart on a surface that faces the camera. Surfaces
    seen edge-on are left out. Returns one sample per margin width: the same points in the same arrays,
    with other `inner` and `in_margin`."""
    valid = image.valid
    coarse = image.subsample(8)
    depth = image.points[coarse][..., 2][valid[coarse]]
    pixel_mm = float(np.median(depth)) / image.camera.alpha if len(depth) else spacing_mm
    step = max(1, round(spacing_mm / pixel_mm))
    grid = image.subsample(step, step // 2)
    measured = valid[grid]
    points, normals = (a[grid][measured].astype(np.float64) for a in (image.points, image.normals))
    facing = -np.einsum("nc,nc->n", points, normals) / np.linalg.norm(points, axis=-1)
    chosen = facing > MIN_VIEW_COSINE  # false for NaN normals as well
    points, normals = points[chosen], normals[chosen]
    sigma_mm = (image.sigma_mm[grid][measured] * facing)[chosen]
    windows = (np.ones((2 * margin + 1, 2 * margin + 1), np.uint8) for margin in margins_px)
    eroded = [cv2.erode(valid.view(np.uint8), window) > 0 for window in windows]
    return tuple(
        SampledPoints(image, inner, points, normals, sigma_mm, ~inner[grid][measured][chosen])
        for inner in eroded
    )


def match_projected(
    source: SampledPoints,
    target: SampledPoints,
    rig_from_source: RigidTransform,
    rig_from_target: RigidTransform,
    reach_mm: float,
) -> Matches:
    """Match each source point with the target's surface at the pixel that it projects to.

    reach_mm: matches at a larger distance along the normal are dropped.
    """
    target_from_source = rig_from_target.inverse() @ rig_from_source
    size, image = len(source.points), target.image
    points, normals = np.empty((size, 3)), np.empty((size, 3))
    distances, sigma_mm, number = np.empty(size), np.empty(size), np.empty(size, np.int64)
    found = _match_projected(
        np.ascontiguousarray(target_from_source.matrix[:3]),
        make_projection_table(image.camera),
        (source.points, source.normals, source.sigma_mm, source.in_margin),
        (image.points, image.normals, image.sigma_mm, target.inner),
        image.corner,
        reach_mm,
        (points, normals, distances, sigma_mm, number),
    )
    return Matches(
        rig_from_target.apply(points[:found]),
        rig_from_target.rotate(normals[:found]),
        distances[:found],
        sigma_mm[:found],
        number[:found],
    )


@compiled
def _match_projected(
    target_from_source: Array,
    projection: Table,
    source: tuple[Array, Array, Array, Mask],
    target: tuple[Floats, Floats, Floats, Mask],
    corner: tuple[int, int],
    reach_mm: float,
    matches: tuple[Array, Array, Array, Array, Indices],
) -> int:
    """Fill `matches`, target frame, and return their number.

    target_from_source: (3, 4).
    source: points (N, 3), normals (N, 3), sigma_mm (N,), in_margin (N,). target: the same of the part
        (H, W) of its image that begins at `corner`, with `inner` in place of the last.
    matches: the arrays of `Matches`, with room for N.
    """
    source_points, source_normals, source_sigma, in_margin = source
    target_points, target_normals, target_sigma, inner = target
    points, normals, distances, sigma_mm, number = matches
    height, width = inner.shape
    found = 0
    for n in range(len(source_points)):
        if in_margin[n]:
            continue
        point = _transform(target_from_source, source_points[n], 1.0)
        normal = _transform(target_from_source, source_normals[n], 0.0)
        if point[2] <= 100.0:  # mm in front of the camera
            continue
        range_mm = np.sqrt(_dot(point, point))
        if -_dot(point, normal) < MIN_VIEW_COSINE * range_mm:
            continue
        u, v = look_up(projection, point[0] / point[2], point[1] / point[2])
        if not (-0.5 < u - corner[1] < width - 0.5 and -0.5 < v - corner[0] < height - 0.5):
            continue
        row, column = int(np.rint(v)) - corner[0], int(np.rint(u)) - corner[1]
        if not inner[row, column]:
            continue
        target_normal = _vector(target_normals[row, column])
        cosine = _dot(normal, target_normal)
        if not cosine > MIN_NORMAL_COSINE:
            continue
        target_point = _vector(target_points[row, column])
        length = np.sqrt(2.0 + 2.0 * cosine)  # of the sum of two unit vectors
        distance = 0.0
        for k in range(3):
            points[found, k], normals[found, k] = point[k], (normal[k] + target_normal[k]) / length
            distance += (point[k] - target_point[k]) * normals[found, k]
        if not abs(distance) < reach_mm:
            continue
        one, other = source_sigma[n], target_sigma[row, column] * _dot(point, target_normal)
        distances[found], sigma_mm[found] = distance, np.sqrt(one**2 + (other / range_mm) ** 2)
        number[found] = n
        found += 1
    return found


@compiled
def _transform(a_from_b: Array, vector: Array, w: float) -> Vector:
    """Transform homogeneous coordinates (vector, w) by a_from_b (3, 4); w = 0 for directions."""
    m, (x, y, z) = a_from_b, (vector[0], vector[1], vector[2])
    return (
        m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3] * w,
        m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3] * w,
        m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3] * w,
    )


@compiled
def _vector(row: Floats) -> Vector:
    return np.float64(row[0]), np.float64(row[1]), np.float64(row[2])


@compiled
def _dot(one: Vector, other: Vector) -> float:
    return one[0] * other[0] + one[1] * other[1] + one[2] * other[2]
