"""Which points of two range images are the same spot of the subject.

Each point is looked up in the other camera's pixel grid, which needs no search and shows where that
camera saw nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from bodyscan.arrays import Array, Floats, Indices, Mask
from bodyscan.compiled import compiled
from bodyscan.geometry.camera_tables import projection_table
from bodyscan.geometry.quadratic_table import Table, look_up
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.reconstruction.range_image import RangeImage

Vector = tuple[float, float, float]

FACING = 0.7  # least cosine between the normals of one spot
EDGE_ON = 0.3  # least cosine between a normal and the viewing ray
NEAREST_MM = 100.0
RIM_PX = 4
SEAM_RIM_PX = 2  # blur is narrower than this; only its bias remains
SEAM_BIAS_MM = 0.3


@dataclass(frozen=True, eq=False)
class AlignmentPoints:
    """The points of one range image that take part in alignment, camera frame.

    inner: (h, w), pixels away from the rim. At silhouettes blur mixes a surface with its
        brighter parts that face the camera more, which lifts it by a few tenths of a millimetre.
    points, normals: (N, 3).
    sigma_mm: standard deviations along the normal, (N,).
    rim: whether points lie at the rim of what was measured, (N,).
    """

    image: RangeImage
    inner: Mask
    points: Array
    normals: Array
    sigma_mm: Array
    rim: Mask

    def some(self, chosen: Mask | slice) -> AlignmentPoints:
        return replace(
            self,
            points=self.points[chosen].copy(),
            normals=self.normals[chosen].copy(),
            sigma_mm=self.sigma_mm[chosen].copy(),
            rim=self.rim[chosen].copy(),
        )


@dataclass(frozen=True, eq=False)
class Matches:
    """M spots seen twice, rig frame.

    points: of the source, (M, 3) mm.
    normals: (M, 3).
    distances: from the target's surface to the source along the normal, (M,) mm.
    sigma_mm: their expected sigmas, (M,).
    source: indices of the source's points, (M,).
    """

    points: Array
    normals: Array
    distances: Array
    sigma_mm: Array
    source: Indices

    @property
    def of_seam(self) -> Matches:
        """The same with the bias of rims included in the sigmas."""
        return replace(self, sigma_mm=np.hypot(self.sigma_mm, SEAM_BIAS_MM))


def alignment_points(image: RangeImage, spacing_mm: float, rim_px: int = RIM_PX) -> AlignmentPoints:
    """Points in every n-th row and column, about `spacing_mm` apart on surfaces facing the camera.

    Surfaces seen edge-on take no part.
    """
    return points_within_rims(image, spacing_mm, rim_px)[0]


def points_within_rims(
    image: RangeImage, spacing_mm: float, *rims_px: int
) -> tuple[AlignmentPoints, ...]:
    """`alignment_points` for several widths of the rim: the same points, in the same arrays."""
    valid = image.valid
    few = image.every(8)
    depth = image.points[few][..., 2][valid[few]]
    pixel_mm = float(np.median(depth)) / image.camera.alpha if len(depth) else spacing_mm
    step = max(1, round(spacing_mm / pixel_mm))
    some = image.every(step, step // 2)
    seen = valid[some]
    points, normals = (a[some][seen].astype(np.float64) for a in (image.points, image.normals))
    facing = -np.einsum("nc,nc->n", points, normals) / np.linalg.norm(points, axis=-1)
    chosen = facing > EDGE_ON  # false for NaN normals as well
    points, normals = points[chosen], normals[chosen]
    sigma_mm = (image.sigma_mm[some][seen] * facing)[chosen]
    windows = (np.ones((2 * rim + 1, 2 * rim + 1), np.uint8) for rim in rims_px)
    inner = [cv2.erode(valid.view(np.uint8), window) > 0 for window in windows]
    return tuple(
        AlignmentPoints(image, own, points, normals, sigma_mm, ~own[some][seen][chosen])
        for own in inner
    )


def match_projected(
    source: AlignmentPoints,
    target: AlignmentPoints,
    rig_from_source: RigidTransform,
    rig_from_target: RigidTransform,
    reach_mm: float,
) -> Matches:
    """Match each source point with the surface that the target camera saw in its direction."""
    target_from_source = rig_from_target.inverse() @ rig_from_source
    size, image = len(source.points), target.image
    points, normals = np.empty((size, 3)), np.empty((size, 3))
    distances, sigma_mm, number = np.empty(size), np.empty(size), np.empty(size, np.int64)
    found = _match_projected(
        np.ascontiguousarray(target_from_source.matrix[:3]),
        projection_table(image.camera),
        (source.points, source.normals, source.sigma_mm, source.rim),
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
    """Match the source's points and fill `matches`, target frame; return their number.

    target_from_source: (3, 4).
    source: points (N, 3), normals (N, 3), sigma_mm (N,), rim (N,).
    target: points (H, W, 3), normals (H, W, 3), sigma_mm (H, W), inner (H, W), of the part of its
        image that begins at `corner`.
    matches: the arrays of `Matches`, with room for N.
    """
    source_points, source_normals, source_sigma, rim = source
    target_points, target_normals, target_sigma, inner = target
    points, normals, distances, sigma_mm, number = matches
    height, width = inner.shape
    found = 0
    for n in range(len(source_points)):
        if rim[n]:
            continue
        point = _carried(target_from_source, source_points[n], 1.0)
        normal = _carried(target_from_source, source_normals[n], 0.0)
        if point[2] <= NEAREST_MM:
            continue
        far = np.sqrt(_dot(point, point))
        if -_dot(point, normal) < EDGE_ON * far:
            continue
        u, v = look_up(projection, point[0] / point[2], point[1] / point[2])
        if not (-0.5 < u - corner[1] < width - 0.5 and -0.5 < v - corner[0] < height - 0.5):
            continue
        row, column = int(np.rint(v)) - corner[0], int(np.rint(u)) - corner[1]
        if not inner[row, column]:
            continue
        across = _vector(target_normals[row, column])
        cosine = _dot(normal, across)
        if not cosine > FACING:
            continue
        there = _vector(target_points[row, column])
        # Length of the sum of two unit vectors, from the cosine of their angle.
        size = np.sqrt(2.0 + 2.0 * cosine)
        distance = 0.0
        for k in range(3):
            points[found, k], normals[found, k] = point[k], (normal[k] + across[k]) / size
            distance += (point[k] - there[k]) * normals[found, k]
        if not abs(distance) < reach_mm:
            continue
        ours, theirs = source_sigma[n], target_sigma[row, column] * _dot(point, across) / far
        distances[found], sigma_mm[found] = distance, np.sqrt(ours * ours + theirs * theirs)
        number[found] = n
        found += 1
    return found


@compiled
def _carried(a_from_b: Array, vector: Array, moved: float) -> Vector:
    """A vector (3,) rotated by a_from_b (3, 4), and translated if `moved` is 1."""
    m, (x, y, z) = a_from_b, (vector[0], vector[1], vector[2])
    return (
        m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3] * moved,
        m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3] * moved,
        m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3] * moved,
    )


@compiled
def _vector(row: Floats) -> Vector:
    return np.float64(row[0]), np.float64(row[1]), np.float64(row[2])


@compiled
def _dot(one: Vector, other: Vector) -> float:
    return one[0] * other[0] + one[1] * other[1] + one[2] * other[2]
