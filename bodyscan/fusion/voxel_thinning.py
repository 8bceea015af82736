"""Thin many points to a given number of evenly spread samples, one for each voxel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bodyscan.arrays import Bytes, Floats, Mask
from bodyscan.compiled import compiled
from bodyscan.errors import ScanFailed
from bodyscan.fusion.smoothing import SmoothSurface
from bodyscan.progress import THREADS, map_threads


@dataclass(frozen=True, eq=False)
class Samples:
    """N points taken from the surfaces, surface by surface, rig frame."""

    points: Floats
    normals: Floats
    sigma_mm: Floats
    # weight, colours: as in SmoothSurface.
    weight: Floats
    colours: Bytes
    starts: NDArray[np.intp]  # where each surface's points begin, (surfaces + 1,)


def take_samples(surfaces: Sequence[SmoothSurface], points: int) -> Samples:
    """About `points` evenly spread samples of all surfaces. Raises ScanFailed if there are few."""
    ends = np.cumsum([0, *(len(surface.points) for surface in surfaces)])
    if ends[-1] < 1000:
        raise ScanFailed(
            f"the range images show next to nothing of a subject ({ends[-1]} points)",
            remedy="Look at the range images; is the subject inside the scan volume?",
        )

    pixels = [np.arange(len(surface.points)) for surface in surfaces]
    if ends[-1] > points:
        every = np.concatenate([surface.points for surface in surfaces])
        at_rim = np.concatenate([surface.rim < 0.5 for surface in surfaces])
        chosen = select_per_voxel(every, at_rim, find_voxel_size(every, points))
        parts = np.split(chosen, np.searchsorted(chosen, ends[1:-1]))
        pixels = [part - start for part, start in zip(parts, ends, strict=False)]

    def pool(name: str) -> NDArray[Any]:
        fields = [getattr(surface, name) for surface in surfaces]
        taken = [field.take(some, axis=0) for field, some in zip(fields, pixels, strict=True)]
        return np.concatenate(taken)

    return Samples(
        pool("points"),
        pool("normals"),
        pool("sigma_mm"),
        pool("weight"),
        pool("colours"),
        np.cumsum([0, *(some.size for some in pixels)]),
    )


def find_voxel_size(points: Floats, wanted: int) -> float:
    """Find the edge (mm) of voxels of which about `wanted` are occupied by points (N, 3) mm.

    Their number is inversely proportional to the square of their edge; up to four corrections
    settle the rest. Of more than 300,000 points one layer of voxels in four is counted.
    """
    size, low = 1.2, points.min(axis=0)
    layers = 4 if len(points) > 300_000 else 1
    equal = np.zeros(len(points), np.bool_)
    for _ in range(4):
        ratio = layers * len(_find_best_per_voxel(points, equal, low, size, layers, 0)) / wanted
        size *= float(np.clip(np.sqrt(ratio), 0.25, 4.0))
        if abs(ratio - 1.0) < 0.05:
            break
    return size


def select_per_voxel(points: Floats, second_rate: Mask, voxel_mm: float) -> NDArray[np.intp]:
    """Select one point in each occupied voxel, the nearest to its centre, second-rate ones (N,)
    only where there is no other; return their indices, ascending."""
    low = points.min(axis=0)
    parts = map_threads(
        lambda layer: _find_best_per_voxel(points, second_rate, low, voxel_mm, THREADS, layer),
        range(THREADS),
    )
    return np.sort(np.concatenate(parts))


@compiled
def _find_best_per_voxel(
    points: Floats, second_rate: Mask, low: Floats, voxel_mm: float, layers: int, layer: int
) -> NDArray[np.intp]:
    """Index of the best point of each voxel, in every `layers`-th layer of blocks from `layer` on. A
    hash table of voxels (Teschner et al. 2003), by blocks of 4 x 4 x 4 that stay together in memory.
    Badness and index share one integer, so that the least of these is the best point."""
    scale = np.float32(1.0 / voxel_mm)
    members, size = 0, 1
    for n in range(len(points)):
        members += (int((points[n, 2] - low[2]) * scale) >> 2) % layers == layer
    while size < 2 * members:
        size *= 2
    keys, best = np.full(size, -1, np.int64), np.empty(size, np.int64)
    for n in range(len(points)):
        z = int((points[n, 2] - low[2]) * scale)
        if (z >> 2) % layers != layer:
            continue
        x, y = int((points[n, 0] - low[0]) * scale), int((points[n, 1] - low[1]) * scale)
        bad = np.float32(1.0) if second_rate[n] else np.float32(0.0)
        for k in range(3):
            position = (points[n, k] - low[k]) * scale
            offset = position - np.floor(position) - np.float32(0.5)
            bad += offset * offset  # at most 0.75 in all
        rank = int(bad * np.float32(1 << 29)) << 32 | n
        key = (x << 21 | y) << 21 | z
        block = (x >> 2) * 73856093 ^ (y >> 2) * 19349663 ^ (z >> 2) * 83492791
        slot = (block << 6 | (x & 3) << 4 | (y & 3) << 2 | z & 3) & (size - 1)
        while keys[slot] >= 0 and keys[slot] != key:
            slot = (slot + 1) & (size - 1)
        if keys[slot] < 0:
            keys[slot], best[slot] = key, rank
        else:
            best[slot] = min(best[slot], rank)
    return best[keys >= 0] & 0xFFFFFFFF
