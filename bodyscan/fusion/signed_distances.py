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
    """Signed distances at all nodes of a grid, negative inside.

    values: (a, b, c) mm.
    origin: the first node, (3,) mm.
    cell_mm: from node to node.
    """

    values: Floats
    origin: Array
    cell_mm: float


def splat_planes(
    cloud: BodyCloud, bricks: Bricks, reach: float = REACH_CELLS
) -> tuple[Floats, Floats]:
    """Signed distances (B, SIDE, SIDE, SIDE) mm, negative inside, and their weights.

    Each point contributes its tangent plane to the nodes within `reach` cells, with a weight that
    falls
    with distance and sigma: 1 for one point right at the node, 0 (and distance 0) without points.
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


def find_near_bricks(points: Array, origin: Array, cell_mm: float, shape: tuple[int, ...]) -> Mask:
    """Find the bricks (a, b, c) with nodes within, or next to, a point's reach."""
    near = np.zeros(shape, np.bool_)
    _mark_near((points - origin) / cell_mm, near)
    return near


@compiled
def _mark_near(points: Array, near: Mask) -> None:
    margin = REACH_CELLS + 2.0
    for n in range(len(points)):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        for corner in range(8):
            a = np.int64(x + (margin if corner & 1 else -margin)) // SIDE
            b = np.int64(y + (margin if corner & 2 else -margin)) // SIDE
            c = np.int64(z + (margin if corner & 4 else -margin)) // SIDE
            near[a, b, c] = True


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
    """Interpolate distances at the nodes of a finer grid with the same origin."""
    found = np.empty(bricks.shape, np.float32)
    _interpolate(distances.values, bricks.cell_mm / distances.cell_mm, bricks.indices, found)
    return found


@compiled
def _interpolate(values: Floats, ratio: float, indices: NDArray[np.int32], found: Floats) -> None:
    """Trilinear; beyond the grid as at its rim."""
    last = np.array(values.shape) - 1.0
    for brick in range(len(indices)):
        for i in range(SIDE):
            x = min((SIDE * indices[brick, 0] + i) * ratio, last[0] - 1e-6)
            for j in range(SIDE):
                y = min((SIDE * indices[brick, 1] + j) * ratio, last[1] - 1e-6)
                for k in range(SIDE):
                    z = min((SIDE * indices[brick, 2] + k) * ratio, last[2] - 1e-6)
                    found[brick, i, j, k] = _trilinear(values, x, y, z)


@compiled
def _trilinear(values: Floats, x: float, y: float, z: float) -> float:
    a, b, c = int(x), int(y), int(z)
    p, q, r = x - a, y - b, z - c
    total = 0.0
    for corner in range(8):
        i, j, k = corner & 1, corner >> 1 & 1, corner >> 2
        share = (p if i else 1.0 - p) * (q if j else 1.0 - q) * (r if k else 1.0 - r)
        total += share * values[a + i, b + j, c + k]
    return total
