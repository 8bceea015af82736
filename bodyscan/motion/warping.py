"""Warp range images to one moment: displace every pixel by the motion of its cell of the body."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bodyscan.arrays import Array, Floats, Indices
from bodyscan.compiled import compiled
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.motion.body_cells import BodyCells, express_in_camera
from bodyscan.motion.estimation import EstimatedMotion
from bodyscan.progress import map_threads
from bodyscan.reconstruction.range_image import RangeImage

Numbers = NDArray[np.int32]


def warp_to_middle(
    images: Sequence[RangeImage],
    rig_from_camera: Mapping[str, RigidTransform],
    motion: EstimatedMotion | None,
) -> list[RangeImage]:
    """Warp all range images to the middle of the scan; unchanged without a motion."""
    if motion is None:
        return list(images)

    def warp(image: RangeImage) -> RangeImage:
        return warp_image(
            image, rig_from_camera[image.pair], motion.cells, motion.warps[image.pair]
        )

    return map_threads(warp, images)


def warp_image(
    image: RangeImage, rig_from_camera: RigidTransform, cells: BodyCells, field: Array
) -> RangeImage:
    """Displace the points and normals of a range image by a field (C, 12), rig frame.

    Cells are looked up for one pixel in each block of 8 mm, a quarter of a cell; a pixel's
    displacement is interpolated between the blocks around it.
    """
    valid = image.valid
    if not valid.any():
        return image
    coarse = image.subsample(8)
    depth_mm = float(np.median(image.points[coarse][..., 2][valid[coarse]]))
    pixel_mm = depth_mm / image.camera.alpha
    size = max(1, round(8.0 / pixel_mm)) if np.isfinite(pixel_mm) else 1
    pixel = _pick_one_per_block(image.sigma_mm, image.corner, size)
    block = pixel >= 0
    rows, columns = np.divmod(pixel[block], valid.shape[1])
    chosen = image.points[rows, columns].astype(np.float64)
    normals = image.normals[rows, columns].astype(np.float64)
    to_camera = -chosen / np.linalg.norm(chosen, axis=1, keepdims=True)
    normals = np.where(np.isfinite(normals), normals, to_camera)
    cell, depth = np.full(block.shape, -1, np.int32), np.zeros(block.shape, np.float32)
    cell[block] = cells.find(rig_from_camera.apply(chosen), rig_from_camera.rotate(normals))
    depth[block] = chosen[:, 2]
    points, rotated = image.points.copy(), image.normals.copy()
    camera_from_rig = rig_from_camera.inverse()
    _warp(
        points,
        rotated,
        image.sigma_mm,
        image.corner,
        size,
        (cell, depth),
        (camera_from_rig.apply(cells.centres), express_in_camera(field, rig_from_camera)),
    )
    return replace(image, points=points, normals=rotated, warped=True)


@compiled
def _pick_one_per_block(sigma_mm: Floats, corner: tuple[int, int], size: int) -> Numbers:
    """Index (h, w) of the measured pixel nearest to each block's middle, -1 if there is none.

    corner: where this part of the image begins; blocks are counted from the image's corner.
    """
    height, width = sigma_mm.shape
    top, left = corner
    above, before = top // size, left // size
    blocks = -(-(top + height) // size) - above, -(-(left + width) // size) - before
    found = np.full(blocks, np.int32(-1))
    nearest = np.full(found.shape, np.inf)
    middle = 0.5 * (size - 1)
    for v in range(height):
        row = (top + v) // size
        for u in range(width):
            if not np.isfinite(sigma_mm[v, u]):
                continue
            column = (left + u) // size
            dy, dx = top + v - row * size - middle, left + u - column * size - middle
            distance2 = dy**2 + dx**2
            if distance2 < nearest[row - above, column - before]:
                nearest[row - above, column - before] = distance2
                found[row - above, column - before] = v * width + u
    return found


@compiled
def _warp(
    points: Floats,
    normals: Floats,
    sigma_mm: Floats,
    corner: tuple[int, int],
    size: int,
    blocks: tuple[Numbers, Floats],
    motion: tuple[Array, Array],
) -> None:
    """Displace measured points (H, W, 3) and their normals, camera frame.

    blocks: cells (h, w) of the blocks, -1 for none, and their depths. motion: centres (C, 3) of the
        cells and fields (C, 12). A pixel averages the motions of the four blocks around it with
        bilinear weights, without blocks that lie on another surface.
    """
    cell, depth = blocks
    rows, columns = cell.shape
    above, before = corner[0] // size, corner[1] // size
    shift, slope = np.empty(3), np.empty((3, 3))
    found, weights = np.empty(4, np.int64), np.empty(4)
    for v in range(sigma_mm.shape[0]):
        y = (corner[0] + v + 0.5) / size - 0.5
        top = int(np.floor(y))
        for u in range(sigma_mm.shape[1]):
            if not np.isfinite(sigma_mm[v, u]):
                continue
            x = (corner[1] + u + 0.5) / size - 0.5
            left = int(np.floor(x))
            count, total = 0, 0.0
            for side in range(4):
                row, column = top + side // 2, left + side % 2
                i, j = row - above, column - before
                if i < 0 or j < 0 or i >= rows or j >= columns:
                    continue
                number = cell[i, j]
                same_block = row == (corner[0] + v) // size and column == (corner[1] + u) // size
                # An arm is farther than 40 mm in front of the trunk, or moves like it.
                same_surface = abs(depth[i, j] - points[v, u, 2]) < 40.0
                if number < 0 or not (same_block or same_surface):
                    continue
                weight = (1.0 - abs(y - row)) * (1.0 - abs(x - column))
                total += weight
                if count and found[count - 1] == number:
                    weights[count - 1] += weight
                else:
                    found[count], weights[count] = number, weight
                    count += 1
            for n in range(count):
                weights[n] /= total
            _mix_fields(found[:count], weights[:count], motion, points[v, u], shift, slope)
            a, b, c = normals[v, u]
            for k in range(3):
                points[v, u, k] += shift[k]
                # The deformation's inverse transpose carries a normal, here to first order.
                normals[v, u, k] -= slope[k, 0] * a + slope[k, 1] * b + slope[k, 2] * c


@compiled
def _mix_fields(
    cells: Indices,
    weights: Array,
    motion: tuple[Array, Array],
    point: Floats,
    shift: Array,
    slope: Array,
) -> None:
    """Set the weighted mean displacement (3,) and gradient (3, 3) of some cells at a point (3,)."""
    centres, fields = motion
    shift[:] = 0.0
    slope[:, :] = 0.0
    for number, weight in zip(cells, weights):  # noqa: B905  (compiled)
        for k in range(3):
            shift[k] += weight * fields[number, k]
            for axis in range(3):
                gradient = weight * fields[number, 3 + 3 * axis + k]
                slope[axis, k] += gradient
                shift[k] += gradient * (point[axis] - centres[number, axis])
