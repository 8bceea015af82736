"""Signed distances from a cloud's tangent planes, averaged at the nodes of a sparse grid."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bodyscan.arrays import Array, Floats, Mask
from bodyscan.compiled import compiled
from bodyscan.mesh.body import BodyCloud
from bodyscan.mesh.surface_nets import SIDE, Bricks

REACH_CELLS = 1.3  # of a point: an edge that crosses the surface ends within one cell
MOST_SIGMAS = 3.0  # largest ratio of a point's sigma to the median one, either way


def splat(cloud: BodyCloud, bricks: Bricks, reach: float = REACH_CELLS) -> tuple[Floats, Floats]:
    """Signed distances (B, SIDE, SIDE, SIDE) mm, negative inside, and their weights.

    Each point contributes its tangent plane to the nodes within `reach` cells, as their distance in
    front of it, with a weight that falls with their distance from the point and with its sigma. A
    weight of 1 is one point right at the node; without points both weight and distance are 0.
    """
    middle = float(np.median(cloud.sigma_mm))
    relative = np.clip(cloud.sigma_mm / max(middle, 1e-6), 1.0 / MOST_SIGMAS, MOST_SIGMAS)
    places = (cloud.points - bricks.origin) / bricks.cell_mm
    sums, weights = np.zeros(bricks.shape, np.float32), np.zeros(bricks.shape, np.float32)
    credit = (relative**-2.0).astype(np.float32)
    _add_planes(bricks.table, places, cloud.normals, credit, reach, sums, weights)
    sums *= bricks.cell_mm
    np.divide(sums, weights, out=sums, where=weights > 0.0)
    return sums, weights


def touched(points: Array, origin: Array, cell_mm: float, shape: tuple[int, ...]) -> Mask:
    """Which bricks (a, b, c) hold nodes within a point's reach, or nodes next to such."""
    wanted = np.zeros(shape, np.bool_)
    _touch((points - origin) / cell_mm, wanted)
    return wanted


@compiled
def _touch(places: Array, wanted: Mask) -> None:
    margin = REACH_CELLS + 2.0
    for n in range(len(places)):
        x, y, z = places[n, 0], places[n, 1], places[n, 2]
        for corner in range(8):
            a = np.int64(x + (margin if corner & 1 else -margin)) // SIDE
            b = np.int64(y + (margin if corner & 2 else -margin)) // SIDE
            c = np.int64(z + (margin if corner & 4 else -margin)) // SIDE
            wanted[a, b, c] = True


@compiled
def _add_planes(
    table: NDArray[np.int32],
    places: Array,
    normals: Floats,
    credit: Floats,
    reach: float,
    sums: Floats,
    weights: Floats,
) -> None:
    """Add up weights, and weights times distances in cells; places: (N, 3), in cells."""
    size = int(2 * reach) + 1
    for n in range(len(places)):
        x, y, z = places[n, 0], places[n, 1], places[n, 2]
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
                        weight = credit[n] * share**4
                        at = i % SIDE, j % SIDE, k % SIDE
                        weights[brick, at[0], at[1], at[2]] += weight
                        sums[brick, at[0], at[1], at[2]] += weight * (plane + r * (k - z))
