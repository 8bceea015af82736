"""Carry range images to one moment: every pixel by the motion of its cell of the body."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bodyscan.alignment.body_cells import BodyCells, seen_from
from bodyscan.alignment.following import Followed
from bodyscan.arrays import Array, Floats
from bodyscan.compiled import compiled
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.progress import THREADS
from bodyscan.reconstruction.range_image import RangeImage

Numbers = NDArray[np.int32]

BLOCK_MM = 8.0  # a quarter of a cell
SAME_SURFACE_MM = 40.0  # in depth; an arm is farther in front of the trunk, or moves like it


def at_once(
    images: Sequence[RangeImage],
    rig_from_camera: Mapping[str, RigidTransform],
    followed: Followed | None,
    *,
    workers: int = THREADS,
) -> list[RangeImage]:
    """All range images carried to the middle of the scan, if the person moved."""
    if followed is None:
        return list(images)

    def one(image: RangeImage) -> RangeImage:
        there = rig_from_camera[image.pair]
        return bend(image, there, followed.cells, followed.bends[image.pair])

    with ThreadPoolExecutor(workers) as pool:
        return list(pool.map(one, images))


def bend(
    image: RangeImage, rig_from_camera: RigidTransform, cells: BodyCells, field: Array
) -> RangeImage:
    """Displace the points and normals of a range image by a field (C, 12), rig frame.

    The cell of a pixel is looked up for one pixel in each block, and interpolated smoothly between
    blocks.
    """
    valid = image.valid
    if not valid.any():
        return image
    few = image.every(8)
    pixel_mm = float(np.median(image.points[few][..., 2][valid[few]])) / image.camera.alpha
    size = max(1, round(BLOCK_MM / pixel_mm)) if np.isfinite(pixel_mm) else 1
    pixel = _one_in_each_block(image.sigma_mm, image.corner, size)
    block = pixel >= 0
    rows, columns = np.divmod(pixel[block], valid.shape[1])
    chosen = image.points[rows, columns].astype(np.float64)
    normals = image.normals[rows, columns].astype(np.float64)
    ahead = -chosen / np.linalg.norm(chosen, axis=1, keepdims=True)
    normals = np.where(np.isfinite(normals), normals, ahead)
    cell, depth = np.full(block.shape, -1, np.int32), np.zeros(block.shape, np.float32)
    cell[block] = cells.find(rig_from_camera.apply(chosen), rig_from_camera.rotate(normals))
    depth[block] = chosen[:, 2]
    points, turned = image.points.copy(), image.normals.copy()
    camera_from_rig = rig_from_camera.inverse()
    _bend(
        points,
        turned,
        image.sigma_mm,
        image.corner,
        size,
        (cell, depth),
        (camera_from_rig.apply(cells.centres), seen_from(field, rig_from_camera)),
    )
    return replace(image, points=points, normals=turned, bent=True)


@compiled
def _one_in_each_block(sigma_mm: Floats, corner: tuple[int, int], size: int) -> Numbers:
    """(h, w): number of the measured pixel nearest to each block's middle, -1 if there is none.

    corner: where this part of the image begins; blocks are counted from the image's own corner.
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
            off = (top + v - row * size - middle) ** 2 + (left + u - column * size - middle) ** 2
            if off < nearest[row - above, column - before]:
                nearest[row - above, column - before] = off
                found[row - above, column - before] = v * width + u
    return found


@compiled
def _bend(
    points: Floats,
    normals: Floats,
    sigma_mm: Floats,
    corner: tuple[int, int],
    size: int,
    blocks: tuple[Numbers, Floats],
    motion: tuple[Array, Array],
) -> None:
    """Displace measured points (H, W, 3) and their normals, camera frame.

    blocks: cells (h, w) of the blocks, -1 for none, and their depths.
    motion: centres (C, 3) of the cells and fields (C, 12).

    A pixel blends the motions of the four blocks around it, weighted by nearness.
    """
    cell, depth = blocks
    centres, fields = motion
    high, wide = cell.shape
    above, before = corner[0] // size, corner[1] // size
    shift, slope = np.empty(3), np.empty((3, 3))
    kinds, weights = np.empty(4, np.int64), np.empty(4)
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
                if i < 0 or j < 0 or i >= high or j >= wide:
                    continue
                there = cell[i, j]
                own = row == (corner[0] + v) // size and column == (corner[1] + u) // size
                near = abs(depth[i, j] - points[v, u, 2]) < SAME_SURFACE_MM
                if there < 0 or not (own or near):
                    continue
                weight = (1.0 - abs(y - row)) * (1.0 - abs(x - column))
                total += weight
                if count and kinds[count - 1] == there:
                    weights[count - 1] += weight
                else:
                    kinds[count], weights[count] = there, weight
                    count += 1
            shift[:] = 0.0
            slope[:, :] = 0.0
            for n in range(count):
                there, share = kinds[n], weights[n] / total
                for k in range(3):
                    shift[k] += share * fields[there, k]
                    for axis in range(3):
                        gradient = share * fields[there, 3 + 3 * axis + k]
                        slope[axis, k] += gradient
                        shift[k] += gradient * (points[v, u, axis] - centres[there, axis])
            a, b, c = normals[v, u]
            for k in range(3):
                points[v, u, k] += shift[k]
                # A normal is carried by the inverse transpose of the deformation, here to first
                # order.
                normals[v, u, k] -= slope[k, 0] * a + slope[k, 1] * b + slope[k, 2] * c
