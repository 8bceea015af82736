"""Which places the cameras saw through, so that no surface can be there."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from bodyscan.arrays import Array, Floats, Indices, Mask
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.reconstruction.range_image import RangeImage

RAY_SPACING_MM = 3.0  # on a subject in the middle of the rig
WIDEST_GAP_MM = 200.0


@dataclass(frozen=True, eq=False)
class Guess:
    """A closed surface that is partly filled: a ray-casting scene, and which faces are."""

    scene: o3d.t.geometry.RaycastingScene
    filled: Mask

    @staticmethod
    def of(vertices: Array, faces: Indices, filled: Mask) -> Guess:
        scene = o3d.t.geometry.RaycastingScene()
        scene.add_triangles(
            o3d.core.Tensor(vertices.astype(np.float32)),
            o3d.core.Tensor(faces.astype(np.uint32)),
        )
        return Guess(scene, filled)


def sees_through(
    points: Floats,
    guess: Guess,
    image: RangeImage,
    rig_from_camera: RigidTransform,
    margin_mm: float,
) -> Mask:
    """Which points (N, 3), rig frame, one camera saw through, by at least `margin_mm`.

    Either something was measured behind them, or they lie in a gap: `gaps`.
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
    """Blocks of stride x stride pixels, of those in a window, that look through a gap of the body.

    There nothing was measured, the ray meets the guessed surface in made-up faces only, and there
    is measured surface to the left and to the right: between the legs, between arm and trunk.
    A ray that enters or leaves through measured surface looks at a part in shadow instead; and a
    part of the outline that nobody measured (dark hair) has measured surface on one side at most.
    """
    rows, columns = (stride * np.arange(some.start, some.stop) + stride // 2 for some in blocks)
    rays = _rays(image.camera, rig_from_camera, rows, columns)
    first = guess.scene.cast_rays(o3d.core.Tensor(rays))["primitive_ids"].numpy()
    hit = first != o3d.t.geometry.RaycastingScene.INVALID_ID
    made_up = np.zeros(hit.shape, bool)
    made_up[hit] = guess.filled[first[hit]]
    body = hit & ~made_up
    near = np.ones((2 * stride + 1, 2 * stride + 1), np.uint8)
    measured = np.pad(cv2.dilate((image.open_depth > 0).astype(np.uint8), near), stride)
    reach = int(WIDEST_GAP_MM / RAY_SPACING_MM)
    open_ = made_up & (measured[np.ix_(rows + stride, columns + stride)] == 0)
    open_ &= _within(body, reach) & _within(body[:, ::-1], reach)[:, ::-1]
    rows, columns = np.nonzero(open_)
    if rows.size:
        open_[rows, columns] = _only_made_up(guess, rays[rows, columns])
    return open_


def _stride(camera: Camera, depth_mm: float) -> int:
    """Pixels between rays, where things are that far away."""
    return max(1, round(RAY_SPACING_MM * camera.alpha / depth_mm))


def _rays(
    camera: Camera,
    rig_from_camera: RigidTransform,
    rows: NDArray[np.intp],
    columns: NDArray[np.intp],
) -> Floats:
    """(h, w, 6) rays through pixels of h rows and w columns, rig frame."""
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1).astype(float)
    rays = np.empty((*pixels.shape[:2], 6), np.float32)
    rays[..., :3] = rig_from_camera.translation
    rays[..., 3:] = _rotate_directions(camera.rays(pixels).astype(np.float32), rig_from_camera)
    return rays


def _within(mask: Mask, reach: int) -> Mask:
    """Whether there is a true pixel at most `reach` to the left in the same row."""
    columns = np.arange(mask.shape[1])
    latest = np.maximum.accumulate(np.where(mask, columns, -reach - 1), axis=1)
    return columns - latest <= reach


def _only_made_up(guess: Guess, rays: Floats) -> Mask:
    """Whether rays (N, 6) meet no measured face on their whole way."""
    crossings = guess.scene.list_intersections(o3d.core.Tensor(rays))
    ray, face = crossings["ray_ids"].numpy(), crossings["primitive_ids"].numpy()
    real = np.bincount(ray[~guess.filled[face]], minlength=len(rays))
    return real == 0


def _transform_points(points: Floats, a_from_b: RigidTransform) -> Floats:
    """Points (..., 3) float32 in b to a; several times quicker than numpy on triples."""
    matrix = np.column_stack([a_from_b.rotation, a_from_b.translation])
    return cv2.transform(points.reshape(1, -1, 3), matrix).reshape(points.shape)


def _rotate_directions(directions: Floats, a_from_b: RigidTransform) -> Floats:
    """Directions (..., 3) float32 in b to a."""
    return cv2.transform(directions.reshape(1, -1, 3), a_from_b.rotation).reshape(directions.shape)
