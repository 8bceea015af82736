"""Thin many points to a given number of evenly spread samples, one for each voxel."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bodyscan.arrays import Bytes, Floats, Mask
from bodyscan.compiled import compiled
from bodyscan.errors import ScanFailed
from bodyscan.fusion.smoothing import SmoothSurface
from bodyscan.progress import THREADS

Numbers = NDArray[np.uint32]


@dataclass(frozen=True, eq=False)
class Samples:
    """N points taken from the surfaces, surface by surface, rig frame.

    starts: where each surface's points begin, (surfaces + 1,).
    weight: as in SmoothSurface.
    """

    points: Floats
    normals: Floats
    sigma_mm: Floats
    weight: Floats
    colours: Bytes
    starts: NDArray[np.intp]


def take_samples(surfaces: Sequence[SmoothSurface], points: int) -> Samples:
    """About `points` evenly spread samples of all surfaces. Raises ScanFailed if these show next
    to nothing."""
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
    settle the rest. Of more than 300,000 points one layer of blocks in four is counted.
    """
    size = 1.2
    box = _bounds(points)
    layers = 4 if len(points) > 300_000 else 1
    for _ in range(4):
        found = _Voxels.from_points(points, box, size, layers)
        ratio = layers * _count_occupied(found.number, found.count) / wanted
        size *= float(np.clip(np.sqrt(ratio), 0.25, 4.0))
        if abs(ratio - 1.0) < 0.05:
            break
    return size


def select_per_voxel(points: Floats, second_rate: Mask, voxel_mm: float) -> NDArray[np.intp]:
    """Select one point in each occupied voxel, the nearest to its centre, second-rate ones (N,)
    only where there is no other; return their indices."""
    box, scale = _bounds(points), np.float32(1.0 / voxel_mm)
    chosen = np.zeros(len(points), np.bool_)

    def choose(layer: int) -> None:
        found = _Voxels.from_points(points, box, voxel_mm, THREADS, layer)
        _select_best(
            points, second_rate, box[0], scale, found.point, found.number, found.count, chosen
        )

    with ThreadPoolExecutor(THREADS) as pool:
        list(pool.map(choose, range(THREADS)))
    return np.flatnonzero(chosen)


@dataclass(frozen=True, eq=False)
class _Voxels:
    """The voxels that points lie in, numbered by blocks, so that neighbours are close in memory.

    point, number: index of a point and number of its voxel, (M,).
    count: how many numbers there are.
    """

    point: Numbers
    number: Numbers
    count: int

    @staticmethod
    def from_points(
        points: Floats, box: tuple[Floats, Floats], voxel_mm: float, layers: int, layer: int = 0
    ) -> _Voxels:
        """Voxels of the points in every `layers`-th layer of blocks, starting from `layer`."""
        low, high = box
        scale = np.float32(1.0 / voxel_mm)
        across = np.floor((high - low) * scale).astype(int) + 1
        bits = 2  # blocks of 4 x 4 x 4, or larger for a box that would have too many
        while np.prod((across >> bits) + 1.0) > 1 << 28:
            bits += 1
        blocks = np.zeros((across >> bits) + 1, np.int32)
        point, number = np.empty((2, len(points)), np.uint32)
        kept, met = _number(points, low, scale, bits, layers, layer, blocks, point, number)
        return _Voxels(point[:kept], number[:kept], met << 3 * bits)


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
    layers: int,
    layer: int,
    blocks: NDArray[np.int32],
    point: Numbers,
    number: Numbers,
) -> tuple[int, int]:
    """Fill in `point` and `number`, numbering blocks as they are met (0: not yet met).

    Returns the numbers of points and of blocks.
    """
    kept, met, within = 0, 0, (1 << bits) - 1
    for n in range(len(points)):
        z = int((points[n, 2] - low[2]) * scale)
        if (z >> bits) % layers != layer:
            continue
        x = int((points[n, 0] - low[0]) * scale)
        y = int((points[n, 1] - low[1]) * scale)
        block = blocks[x >> bits, y >> bits, z >> bits]
        if block == 0:
            met += 1
            block = blocks[x >> bits, y >> bits, z >> bits] = met
        local = ((x & within) << bits | y & within) << bits | z & within
        point[kept], number[kept] = n, (block - 1) << 3 * bits | local
        kept += 1
    return kept, met


@compiled
def _count_occupied(voxels: Numbers, count: int) -> int:
    """How many of `count` voxels occur in `voxels`."""
    found = np.zeros(count, np.bool_)
    occupied = 0
    for voxel in voxels:
        occupied += not found[voxel]
        found[voxel] = True
    return occupied


@compiled
def _select_best(
    points: Floats,
    second_rate: Mask,
    low: Floats,
    scale: np.float32,
    point: Numbers,
    number: Numbers,
    count: int,
    chosen: Mask,
) -> None:
    """Mark the best point of each voxel in chosen (N,); see `_Voxels`."""
    # Badness and index share one integer, so that each voxel takes one memory access.
    empty = np.int64((1 << 63) - 1)
    best = np.full(count, empty)
    for m in range(len(point)):
        n = np.int64(point[m])
        bad = np.float32(1.0) if second_rate[n] else np.float32(0.0)
        for k in range(3):
            position = (points[n, k] - low[k]) * scale
            offset = position - np.floor(position) - np.float32(0.5)
            bad += offset * offset  # at most 0.75 in all
        best[number[m]] = min(best[number[m]], int(bad * np.float32(1 << 29)) << 32 | n)
    for key in best:
        if key != empty:
            chosen[key & 0xFFFFFFFF] = True
