"""Signed distances at the nodes of grids: from a cloud's tangent planes, and from a coarser grid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bodyscan.arrays import Array, Floats, Mask
from bodyscan.compiled import compiled
from bodyscan.mesh.body import BodyCloud
from bodyscan.mesh.surface_nets import SIDE, Bricks

REACH_CELLS = 1.3
"""Reach of a point: an edge that crosses the surface ends within one cell."""


@dataclass(frozen=True, eq=False)
class Distances:
    """Signed distances at all nodes of a grid, negative inside."""

    values: Floats  # (a, b, c) mm
    origin: Array  # the first node, (3,) mm
    cell_mm: float  # from node to node


def splat_planes(
    cloud: BodyCloud, bricks: Bricks, reach: float = REACH_CELLS
) -> tuple[Floats, Floats]:
    """Signed distances (B, SIDE, SIDE, SIDE) mm, negative inside, and their weights.

    Each point contributes its tangent plane to the nodes within `reach` cells, with a weight that
    falls with distance and sigma: 1 for a point right at the node, 0 (as the distance) without.
    """
    median = float(np.median(cloud.sigma_mm))
    relative = np.clip(cloud.sigma_mm / max(median, 1e-6), 1.0 / 3.0, 3.0)
    points = (cloud.points - bricks.origin) / bricks.cell_mm
    sums, weights = np.zeros(bricks.shape, np.float32), np.zeros(bricks.shape, np.float32)
    information = (relative**-2.0).astype(np.float32)
    _add_planes(bricks.table, points, cloud.normals, information, reach, sums, weights)
    sums *= bricks.cell_mm
    np.divide(sums, weights, out=sums, where=weights > 0.0)
    return sums, weights


@compiled
def find_near_bricks(points: Array, origin: Array, cell_mm: float, shape: tuple[int, ...]) -> Mask:
    """Find the bricks (a, b, c) with nodes within, or next to, a point's reach."""
    near, margin = np.zeros(shape, np.bool_), REACH_CELLS + 2.0
    first, last = np.empty(3, np.int64), np.empty(3, np.int64)
    for n in range(len(points)):
        for axis in range(3):
            at = (points[n, axis] - origin[axis]) / cell_mm
            first[axis], last[axis] = (at - margin) // SIDE, (at + margin) // SIDE
        for i in range(first[0], last[0] + 1):
            for j in range(first[1], last[1] + 1):
                near[i, j, first[2] : last[2] + 1] = True
    return near


@compiled
def _add_planes(
    table: NDArray[np.int32],
    points: Array,
    normals: Floats,
    information: Floats,
    reach: float,
    sums: Floats,
    weights: Floats,
) -> None:
    """Add up weights, and weights times distances in cells; points: (N, 3), in cells."""
    size = int(2 * reach) + 1
    for n in range(len(points)):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        p, q, r = normals[n, 0], normals[n, 1], normals[n, 2]
        first = np.int64(np.ceil(z - reach))
        for i in range(np.int64(np.ceil(x - reach)), np.int64(x + reach) + 1):
            for j in range(np.int64(np.ceil(y - reach)), np.int64(y + reach) + 1):
                left = reach**2 - (i - x) ** 2 - (j - y) ** 2
                if left <= 0.0:
                    continue
                plane = p * (i - x) + q * (j - y)
                for k in range(first, first + size):
                    share = (left - (k - z) ** 2) / reach**2
                    if share > 0.0:
                        brick = table[i // SIDE, j // SIDE, k // SIDE]
                        weight = information[n] * share**4
                        at = i % SIDE, j % SIDE, k % SIDE
                        weights[brick, at[0], at[1], at[2]] += weight
                        sums[brick, at[0], at[1], at[2]] += weight * (plane + r * (k - z))


def find_crossed_bricks(distances: Distances, cell_mm: float, shape: tuple[int, ...]) -> Mask:
    """Find the bricks (a, b, c) of a finer grid with the same origin that the surface crosses."""
    low = high = np.pad(distances.values, ((0, 1),) * 3, mode="edge")
    ratio = cell_mm / distances.cell_mm
    for axis, (count, size) in enumerate(zip(shape, distances.values.shape, strict=True)):
        # From the coarse node at or before the cell that precedes a brick to the one at or behind
        # the cell that follows it.
        first = SIDE * np.arange(count)
        ends = [(first - 2) * ratio, (first + SIDE + 1) * ratio + 2.0]
        ranges = np.clip(np.stack(ends, axis=1).astype(int), 0, size).ravel()
        low = np.minimum.reduceat(low, ranges, axis).take(2 * np.arange(count), axis)
        high = np.maximum.reduceat(high, ranges, axis).take(2 * np.arange(count), axis)
    return (low < 0.0) & (high >= 0.0)


def interpolate_distances(distances: Distances, bricks: Bricks) -> Floats:
    """Interpolate distances linearly at the nodes of a finer grid with the same origin; beyond the
    grid as at its rim."""
    return _interpolate(distances.values, bricks.indices, bricks.cell_mm / distances.cell_mm)


@compiled
def _interpolate(values: Floats, indices: NDArray[np.int32], ratio: float) -> Floats:
    """From values (a, b, c) to (B, SIDE, SIDE, SIDE); ratio: of the finer cell to theirs."""
    found = np.empty((len(indices), SIDE, SIDE, SIDE), np.float32)
    first, share = np.empty((3, SIDE), np.int64), np.empty((3, SIDE))
    for brick in range(len(indices)):
        for axis in range(3):
            for node in range(SIDE):
                at = min((SIDE * indices[brick, axis] + node) * ratio, values.shape[axis] - 1.0)
                first[axis, node] = min(int(at), values.shape[axis] - 2)
                share[axis, node] = at - first[axis, node]
        for i in range(SIDE):
            for j in range(SIDE):
                a, b, p, q = first[0, i], first[1, j], share[0, i], share[1, j]
                for k in range(SIDE):
                    c, z, total = first[2, k], share[2, k], 0.0
                    for step in range(4):
                        row = values[a + step // 2, b + step % 2]
                        across = (p if step > 1 else 1.0 - p) * (q if step % 2 else 1.0 - q)
                        total += across * (row[c] + z * (row[c + 1] - row[c]))
                    found[brick, i, j, k] = total
    return found
