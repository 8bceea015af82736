"""Which places cameras saw through, so that no surface can be there."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from bodyscan.arrays import Array, Floats, Indices, Mask
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.mesh.depth_buffer import nearest_faces
from bodyscan.reconstruction.range_image import RangeImage

RAY_SPACING_MM = 3.0  # at a subject in the middle of the rig
WIDEST_GAP_MM = 200.0


@dataclass(frozen=True, eq=False)
class Guess:
    """A closed surface that is partly filled.

    vertices: (V, 3) float32, rig frame.
    faces: (F, 3).
    filled: (F,).
    """

    vertices: Floats
    faces: Indices
    filled: Mask

    @staticmethod
    def of(vertices: Array, faces: Indices, filled: Mask) -> Guess:
        return Guess(vertices.astype(np.float32), faces, filled)


def sees_through(
    points: Floats,
    guess: Guess,
    image: RangeImage,
    rig_from_camera: RigidTransform,
    margin_mm: float,
) -> Mask:
    """Which points (N, 3), rig frame, one camera saw through by at least `margin_mm`.

    Either something was measured behind them, or they lie in a gap: see `gaps`.
    """
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
    open_ = gaps(guess, image, rig_from_camera, stride, blocks)
    through[index] |= open_[block_rows - top, block_columns - left]
    return through


def gaps(
    guess: Guess,
    image: RangeImage,
    rig_from_camera: RigidTransform,
    stride: int,
    blocks: tuple[slice, slice],
) -> Mask:
    """Blocks of stride x stride pixels in a window that look through a gap of the body.

    In such a block nothing was measured, its middle shows only filled faces of the guessed surface,
    and there is measured surface to the left and to the right: between the legs, between arm and
    trunk. A filled face in front of or behind measured surface is a part in shadow instead, and a
    part of the outline that nobody measured (dark hair) has measured surface on one side at most.
    """
    rows, columns = (stride * np.arange(some.start, some.stop) + stride // 2 for some in blocks)
    places = _in_blocks(guess.vertices, image, rig_from_camera, stride, blocks)
    first = nearest_faces(places, guess.faces, len(rows), len(columns))
    hit = first >= 0
    made_up = np.zeros(hit.shape, bool)
    made_up[hit] = guess.filled[first[hit]]
    body = hit & ~made_up
    near = np.ones((2 * stride + 1, 2 * stride + 1), np.uint8)
    measured = np.pad(cv2.dilate((image.open_depth > 0).astype(np.uint8), near), stride)
    reach = int(WIDEST_GAP_MM / RAY_SPACING_MM)
    open_ = made_up & (measured[np.ix_(rows + stride, columns + stride)] == 0)
    open_ &= _within(body, reach) & _within(body[:, ::-1], reach)[:, ::-1]
    real = nearest_faces(places, guess.faces[~guess.filled], len(rows), len(columns))
    return open_ & (real < 0)


def _stride(camera: Camera, depth_mm: float) -> int:
    """Pixels between rays at that depth."""
    return max(1, round(RAY_SPACING_MM * camera.alpha / depth_mm))


def _in_blocks(
    vertices: Floats,
    image: RangeImage,
    rig_from_camera: RigidTransform,
    stride: int,
    blocks: tuple[slice, slice],
) -> Floats:
    """(V, 3): column and row of the block that shows each vertex in its middle, and depth.

    NaN for vertices that are not in front of the camera.
    """
    seen = _transform_points(vertices, rig_from_camera.inverse())
    seen[seen[:, 2] < 1.0] = np.nan
    pixels = (image.camera.project(seen.astype(float)) - stride // 2) / stride
    first = blocks[1].start, blocks[0].start
    return np.concatenate([pixels - first, seen[:, 2:]], axis=1).astype(np.float32)


def _within(mask: Mask, reach: int) -> Mask:
    """Whether there is a true pixel at most `reach` to the left in the same row."""
    columns = np.arange(mask.shape[1])
    latest = np.maximum.accumulate(np.where(mask, columns, -reach - 1), axis=1)
    return columns - latest <= reach


def _transform_points(points: Floats, a_from_b: RigidTransform) -> Floats:
    """Points (..., 3) float32 in b to a; several times faster than numpy on triples."""
    matrix = np.column_stack([a_from_b.rotation, a_from_b.translation])
    return cv2.transform(points.reshape(1, -1, 3), matrix).reshape(points.shape)
