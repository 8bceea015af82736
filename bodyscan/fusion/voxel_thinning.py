"""Thin many points to a given number of evenly spread samples, one for each voxel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bodyscan.arrays import Bytes, Floats, Indices, Mask
from bodyscan.errors import ScanFailed
from bodyscan.fusion.smoothing import SmoothSurface


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
    settle the rest. Of more than 300,000 points one layer of voxels in four is counted.
    """
    size, low = 1.2, points.min(axis=0)
    layers = 4 if len(points) > 300_000 else 1  # each four voxels high
    for _ in range(4):
        layer = ((points[:, 2] - low[2]) * np.float32(1.0 / size)).astype(np.int32) >> 2
        voxel, _ = _number_voxels(points[layer % layers == 0], low, size)
        ratio = layers * len(np.unique(voxel)) / wanted
        size *= float(np.clip(np.sqrt(ratio), 0.25, 4.0))
        if abs(ratio - 1.0) < 0.05:
            break
    return size


def select_per_voxel(points: Floats, second_rate: Mask, voxel_mm: float) -> NDArray[np.intp]:
    """Select one point in each occupied voxel, the nearest to its centre, second-rate ones (N,)
    only where there is no other; return their indices, ascending."""
    voxel, offset = _number_voxels(points, points.min(axis=0), voxel_mm)
    bad = second_rate + np.einsum("nk,nk->n", offset, offset)  # at most 1.75
    # Badness and index share one integer, so that the smallest of these is the best point.
    rank = (bad * (1 << 29)).astype(np.int64) << 32 | np.arange(len(points))
    order = np.argsort(voxel)
    starts = np.flatnonzero(np.diff(voxel[order], prepend=-1))
    return np.sort(np.minimum.reduceat(rank[order], starts) & 0xFFFFFFFF)


def _number_voxels(points: Floats, low: Floats, voxel_mm: float) -> tuple[Indices, Floats]:
    """Number (N,) of each point's voxel, and where in it the point lies, from -0.5 to 0.5, (N, 3)."""
    position = (points - low) * np.float32(1.0 / voxel_mm)
    cell = np.floor(position)
    x, y, z = cell.astype(np.int64).T
    return (x << 21 | y) << 21 | z, position - cell - np.float32(0.5)
