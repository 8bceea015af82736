"""Many points to a given number of evenly spread ones, one for each voxel."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bodyscan.compiled import compiled

Floats = NDArray[np.float32]
Mask = NDArray[np.bool_]

FIRST_GUESS_MM = 1.2
CLOSE_ENOUGH = 0.05  # to the wanted number, for the last correction to settle the rest
ROUNDS = 4
MOST_BLOCKS = 1 << 28  # of voxels in the box around all points
BADNESS_STEPS = np.float32(1 << 29)
EMPTY = np.int64((1 << 63) - 1)


def voxel_size_for(points: Floats, wanted: int) -> float:
    """Edge (mm) of the voxels of which about `wanted` are occupied; points (N, 3) mm.

    A surface occupies voxels in inverse proportion to their edge squared, as long as its points
    lie closer together than that; corrections settle it.
    """
    size = FIRST_GUESS_MM
    box = _bounds(points)
    for _ in range(ROUNDS):
        voxels, count = _numbered(points, box, size)
        ratio = _occupied(voxels, count) / wanted
        size *= float(np.clip(np.sqrt(ratio), 0.25, 4.0))
        if abs(ratio - 1.0) < CLOSE_ENOUGH:
            break
    return size


def one_per_voxel(points: Floats, second_rate: Mask, voxel_mm: float) -> NDArray[np.intp]:
    """Indices of one point in each occupied voxel: the nearest to its centre.

    `second_rate` (N,) points are taken only where a voxel has no other.
    """
    box = _bounds(points)
    voxels, count = _numbered(points, box, voxel_mm)
    return np.flatnonzero(
        _chosen(points, second_rate, box[0], np.float32(1.0 / voxel_mm), voxels, count)
    )


def _numbered(
    points: Floats, box: tuple[Floats, Floats], voxel_mm: float
) -> tuple[NDArray[np.uint32], int]:
    """(N,) a number for each point's voxel, and how many numbers there are.

    Voxels are numbered by blocks, cubes of them, so that neighbours lie together in memory.
    """
    low, high = box
    scale = np.float32(1.0 / voxel_mm)
    voxels_across = np.floor((high - low) * scale).astype(int) + 1
    bits = 2  # blocks of 4 x 4 x 4, or more for a box that has too many of them
    while np.prod((voxels_across >> bits) + 1.0) > MOST_BLOCKS:
        bits += 1
    blocks = np.zeros((voxels_across >> bits) + 1, np.int32)
    voxels = np.empty(len(points), np.uint32)
    return voxels, _number(points, low, scale, bits, blocks, voxels) << 3 * bits


@compiled
def _bounds(points: Floats) -> tuple[Floats, Floats]:
    """Lowest and highest coordinates (3,) of points (N, 3)."""
    low, high = points[0].copy(), points[0].copy()
    for point in points:
        for k in range(3):
            if point[k] < low[k]:
                low[k] = point[k]
            elif point[k] > high[k]:
                high[k] = point[k]
    return low, high


@compiled
def _number(
    points: Floats,
    low: Floats,
    scale: np.float32,
    bits: int,
    blocks: NDArray[np.int32],
    voxels: NDArray[np.uint32],
) -> int:
    """Fill in `voxels` (N,), numbering blocks (0: not yet met) as they are met; how many."""
    met, within = 0, (1 << bits) - 1
    for n in range(len(points)):
        x = int((points[n, 0] - low[0]) * scale)
        y = int((points[n, 1] - low[1]) * scale)
        z = int((points[n, 2] - low[2]) * scale)
        block = blocks[x >> bits, y >> bits, z >> bits]
        if block == 0:
            met += 1
            block = blocks[x >> bits, y >> bits, z >> bits] = met
        place = ((x & within) << bits | y & within) << bits | z & within
        voxels[n] = (block - 1) << 3 * bits | place
    return met


@compiled
def _occupied(voxels: NDArray[np.uint32], count: int) -> int:
    """How many of `count` voxels are among `voxels`."""
    found = np.zeros(count, np.bool_)
    occupied = 0
    for voxel in voxels:
        occupied += not found[voxel]
        found[voxel] = True
    return occupied


@compiled
def _chosen(
    points: Floats,
    second_rate: Mask,
    low: Floats,
    scale: np.float32,
    voxels: NDArray[np.uint32],
    count: int,
) -> Mask:
    """Which points (N,) are the best of their voxels, of which there are `count`."""
    # Badness and index share one integer, so that each voxel is one place in memory.
    best = np.full(count, EMPTY)
    for n in range(len(points)):
        bad = np.float32(1.0) if second_rate[n] else np.float32(0.0)
        for k in range(3):
            place = (points[n, k] - low[k]) * scale
            off_centre = place - np.floor(place) - np.float32(0.5)
            bad += off_centre * off_centre  # at most 0.75 in all
        best[voxels[n]] = min(best[voxels[n]], int(bad * BADNESS_STEPS) << 32 | n)
    chosen = np.zeros(len(points), np.bool_)
    for key in best:
        if key != EMPTY:
            chosen[key & 0xFFFFFFFF] = True
    return chosen
