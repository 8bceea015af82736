"""Many points to a given number of evenly spread ones, by a voxel hash."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Numbers = NDArray[np.uint64]

FIRST_GUESS_MM = 1.2


def voxel_size_for(points: Floats, wanted: int) -> float:
    """Edge (mm) of the voxels of which about `wanted` are occupied; points (N, 3) mm.

    A surface occupies voxels in inverse proportion to their edge squared, as long as its points
    lie closer together than that; corrections settle it. Only every eighth voxel is counted.
    """
    size = FIRST_GUESS_MM
    axes = _axes(points)
    for _ in range(3):
        voxels, _, _ = _voxels(axes, size)
        # Fibonacci hashing: multiples of 2^64 over the golden ratio have well mixed top bits.
        some = np.sort(voxels[(voxels * np.uint64(0x9E3779B97F4A7C15)) >> np.uint64(61) == 0])
        occupied = 8 * (1 + np.count_nonzero(some[1:] != some[:-1]))
        size *= float(np.clip(np.sqrt(occupied / wanted), 0.25, 4.0))
    return size


def one_per_voxel(
    points: Floats, second_rate: NDArray[np.bool_], voxel_mm: float
) -> NDArray[np.intp]:
    """Indices of one point in each occupied voxel: the nearest to its centre.

    `second_rate` (N,) points are taken only where a voxel has no other.
    """
    voxels, offsets, count = _voxels(_axes(points), voxel_mm)
    off_centre = np.sqrt(sum((offset - np.float32(0.5)) ** 2 for offset in offsets) / 0.75)
    # Voxel, rank within it and index share one integer, so that a plain sort does everything.
    index_bits = max(1, (len(points) - 1).bit_length())
    rank_bits = 64 - index_bits - max(1, (count - 1).bit_length())
    rank = (0.5 * np.minimum(off_centre, 0.999) + 0.5 * second_rate) * (1 << rank_bits)
    key = (voxels << np.uint64(rank_bits)) | rank.astype(np.uint64)
    key = np.sort((key << np.uint64(index_bits)) | np.arange(len(points), dtype=np.uint64))
    voxel = key >> np.uint64(index_bits + rank_bits)
    first = np.concatenate([[True], voxel[1:] != voxel[:-1]])
    return np.sort((key[first] & np.uint64((1 << index_bits) - 1)).astype(np.intp))


def _axes(points: Floats) -> Floats:
    """(3, N) coordinates from the lowest on: numpy is slow on arrays of triples."""
    axes = np.ascontiguousarray(points.T)
    return axes - axes.min(axis=1, keepdims=True)


def _voxels(axes: Floats, voxel_mm: float) -> tuple[Numbers, Floats, int]:
    """(N,) number of each point's cube, its place (3, N) in it (0 to 1), and how many cubes."""
    scaled = axes * np.float32(1.0 / voxel_mm)
    cells = np.floor(scaled)
    columns, rows, layers = (int(cell.max()) + 1 for cell in cells)
    x, y, z = cells.astype(np.uint32)
    numbers = x.astype(np.uint64) * np.uint64(rows * layers) + (y * np.uint32(layers) + z)
    return numbers, scaled - cells, columns * rows * layers
