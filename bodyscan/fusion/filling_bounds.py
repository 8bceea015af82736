"""Bounds on filled surface: space that cameras saw through, and the tangent planes of a crown."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import cv2
import numpy as np

from bodyscan.arrays import Array, Floats, Indices, Mask
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.mesh.depth_buffer import nearest_faces
from bodyscan.reconstruction.range_image import RangeImage

RAY_SPACING_MM = 3.0
"""Between rays that look through gaps, at the subject."""
CROWN_RADIUS_MM = 100.0
"""Half the length of a head: what lies farther from its highest point is not part of it."""


@dataclass(frozen=True, eq=False)
class PartialSurface:
    """A closed surface, partly filled: vertices (V, 3) float32, rig frame; faces (F, 3); filled
    (F,)."""

    vertices: Floats
    faces: Indices
    filled: Mask


def find_free_points(
    points: Floats,
    surface: PartialSurface,
    image: RangeImage,
    rig_from_camera: RigidTransform,
    margin_mm: float = 10.0,
) -> Mask:
    """Find the points (N, 3), rig frame, that one camera saw through by at least `margin_mm`:
    something was measured behind them, or they lie in a gap (see `find_gaps`)."""
    in_camera = _transform_points(points, rig_from_camera.inverse())
    ahead = in_camera[:, 2] > 1.0
    u, v = image.camera.project(np.where(ahead[:, None], in_camera, np.float32(1.0))).T
    columns, rows = np.rint(u).astype(np.intp), np.rint(v).astype(np.intp)
    inside = ahead & (columns >= 0) & (columns < image.camera.width)
    inside &= (rows >= 0) & (rows < image.camera.height)
    index = np.flatnonzero(inside)
    through = np.zeros(len(points), bool)
    if not index.size:
        return through
    columns, rows = columns[index], rows[index]
    # The nearest depth around, 0 if anything is missing: rims and flying pixels prove nothing.
    nearest = cv2.erode(image.open_depth, np.ones((5, 5), np.uint8))
    through[index] = in_camera[index, 2] < nearest[rows, columns] - margin_mm
    stride = _stride(image.camera, float(np.median(in_camera[index, 2])))
    block_rows, block_columns = rows // stride, columns // stride
    top, left = block_rows.min(), block_columns.min()
    blocks = slice(top, block_rows.max() + 1), slice(left, block_columns.max() + 1)
    open_ = find_gaps(surface, image, rig_from_camera, stride, blocks)
    through[index] |= open_[block_rows - top, block_columns - left]
    return through


def find_gaps(
    surface: PartialSurface,
    image: RangeImage,
    rig_from_camera: RigidTransform,
    stride: int,
    blocks: tuple[slice, slice],
) -> Mask:
    """Find the blocks of stride x stride pixels in a window that look through a gap of the body.

    In such a block nothing was measured, its middle shows only filled faces, and there is measured
    surface to the left and to the right: between the legs, between arm and trunk. A filled face in
        front of or behind measured surface is a part in shadow instead.
    """
    rows, columns = (stride * np.arange(some.start, some.stop) + stride // 2 for some in blocks)
    vertices = _project_to_blocks(surface.vertices, image, rig_from_camera, stride, blocks)
    first = nearest_faces(vertices, surface.faces, len(rows), len(columns))
    hit = first >= 0
    filled = np.zeros(hit.shape, bool)
    filled[hit] = surface.filled[first[hit]]
    body = hit & ~filled
    near = np.ones((2 * stride + 1, 2 * stride + 1), np.uint8)
    measured = np.pad(cv2.dilate((image.open_depth > 0).astype(np.uint8), near), stride)
    reach = int(200.0 / RAY_SPACING_MM)  # the widest gap
    open_ = filled & (measured[np.ix_(rows + stride, columns + stride)] == 0)
    open_ &= _has_left_neighbour(body, reach) & _has_left_neighbour(body[:, ::-1], reach)[:, ::-1]
    real = nearest_faces(vertices, surface.faces[~surface.filled], len(rows), len(columns))
    return open_ & (real < 0)


def _stride(camera: Camera, depth_mm: float) -> int:
    """Pixels between rays at that depth."""
    return max(1, round(RAY_SPACING_MM * camera.alpha / depth_mm))


def _project_to_blocks(
    vertices: Floats,
    image: RangeImage,
    rig_from_camera: RigidTransform,
    stride: int,
    blocks: tuple[slice, slice],
) -> Floats:
    """(V, 3): column and row of the block that shows each vertex, and depth; NaN behind the
    camera."""
    points = _transform_points(vertices, rig_from_camera.inverse())
    points[points[:, 2] < 1.0] = np.nan
    pixels = (image.camera.project(points.astype(float)) - stride // 2) / stride
    first = blocks[1].start, blocks[0].start
    return np.concatenate([pixels - first, points[:, 2:]], axis=1).astype(np.float32)


def _has_left_neighbour(mask: Mask, reach: int) -> Mask:
    """Whether there is a true pixel at most `reach` to the left in the same row."""
    columns = np.arange(mask.shape[1])
    latest = np.maximum.accumulate(np.where(mask, columns, -reach - 1), axis=1)
    return columns - latest <= reach


def _transform_points(points: Floats, a_from_b: RigidTransform) -> Floats:
    """Points (..., 3) float32 in b to a; several times faster than numpy on triples."""
    matrix = np.column_stack([a_from_b.rotation, a_from_b.translation])
    return cv2.transform(points.reshape(1, -1, 3), matrix).reshape(points.shape)


@dataclass(frozen=True, eq=False)
class Crown:
    """Tangent planes below which everything measured around the top of a head lies.

    A crown is convex: where cameras see its top too flat to measure it, these planes bound the
    head's height to a millimetre; planes around a hairline are steep and bound nothing.

    highest: the highest point measured, (3,) mm.
    normals, offsets: of the planes, (P, 3) and (P,) mm.
    """

    highest: Array
    normals: Array
    offsets: Array

    NOISE_MM: ClassVar[float] = 0.5
    """A plane that measured points exceed by more is no bound: the body is not convex there."""

    @staticmethod
    def from_cloud(points: Array, normals: Array | Floats) -> Crown:
        """The crown of a body's points (N, 3), z up, with normals (N, 3)."""
        highest = points[np.argmax(points[:, 2])]
        near = points[:, 2] > highest[2] - 60.0  # ears begin lower
        near &= np.hypot(*(points[:, :2] - highest[:2]).T) < CROWN_RADIUS_MM
        position, normal = points[near], normals[near].astype(np.float64)
        # A crown bends by 0.1 mm over half a cell of 8 mm.
        cell = np.floor(position / 8.0).astype(np.int64)
        _, number, count = np.unique(cell, axis=0, return_inverse=True, return_counts=True)

        def mean(values: Array) -> Array:
            sums = [np.bincount(number.ravel(), column) for column in values.T]
            return np.asarray(np.stack(sums, axis=1) / count[:, None])

        position, normal = mean(position), mean(normal)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
        offsets = np.sum(position * normal, axis=1)
        above = np.max(normal @ position.T - offsets[:, None], axis=1, initial=0.0)
        bounds = (above < Crown.NOISE_MM) & (normal[:, 2] > 0.5)
        return Crown(highest, normal[bounds], offsets[bounds])

    @property
    def unknown_mm(self) -> float:
        """By how much the head may end higher than was measured; inf if nothing bounds it.

        The planes' lower envelope is concave: ever finer grids around its best node find its top.
        """
        if not len(self.offsets):
            return np.inf
        slopes = self.normals[:, :2] / self.normals[:, 2:]
        above = (self.offsets - self.normals @ self.highest) / self.normals[:, 2]
        centre, half_width, top = np.zeros(2), CROWN_RADIUS_MM, 0.0
        grid = np.stack(np.meshgrid(*[np.linspace(-1.0, 1.0, 21)] * 2), axis=-1).reshape(-1, 2)
        for _ in range(10):  # from 10 mm between nodes to a thousandth of one
            nodes = centre + half_width * grid
            heights = np.min(above - nodes @ slopes.T, axis=1)
            centre, top = nodes[np.argmax(heights)], float(heights.max())
            half_width *= 0.3
        return max(0.0, top)

    def compute_heights_above(self, points: Array) -> Array:
        """Height (N,) mm, at least 0, of points (N, 3) at the top of the head above its planes."""
        near = points[:, 2] > self.highest[2] - 60.0 / 3.0
        near &= np.hypot(*(points[:, :2] - self.highest[:2]).T) < CROWN_RADIUS_MM
        above = np.zeros(len(points))
        if len(self.offsets):
            above[near] = np.max(points[near] @ self.normals.T - self.offsets, axis=1)
        return np.maximum(above, 0.0)
