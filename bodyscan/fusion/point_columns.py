"""Find the nearest points of a cloud within a reach, in columns of a grid.

All points of a body lie on its skin, and all queries have the same reach of a few millimetres:
sorting points into columns from front to back takes a tenth of the time of building a tree, and a
query half.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodyscan.arrays import Array, Indices
from bodyscan.compiled import compiled
from bodyscan.progress import map_threads, split_range


@dataclass(frozen=True, eq=False)
class PointColumns:
    """Points (N, 3) in columns along x, `reach_mm` wide.

    order: indices of the points, column after column, (N,).
    start: where each column begins, by (y, z); columns at the rim are empty.
    low: y and z where the columns begin, (2,) mm.
    """

    points: Array
    order: Indices
    start: Indices
    low: Array
    reach_mm: float

    @staticmethod
    def of(points: Array, reach_mm: float) -> PointColumns:
        """Columns for a cloud and the reach of all queries."""
        low = points[:, 1:].min(axis=0) - reach_mm
        across = ((points[:, 1:] - low) / reach_mm).astype(np.int64)
        shape = across.max(axis=0) + 2
        column = across[:, 0] * shape[1] + across[:, 1]
        start = np.concatenate([[0], np.cumsum(np.bincount(column, minlength=shape.prod()))])
        order = _sort(column, start)
        return PointColumns(points[order], order, start[:-1].reshape(shape), low, reach_mm)

    def nearest(self, places: Array, count: int) -> tuple[Array, Indices]:
        """The nearest points to places (M, 3).

        Distances (M, count) mm, ascending, infinite if fewer points lie within the reach; and their
        indices (M, count), N for missing ones.
        """
        distance = np.full((len(places), count), np.inf)
        near = np.full((len(places), count), len(self.points))

        def find(part: slice) -> None:
            some = np.ascontiguousarray(places[part])
            _find(
                some,
                self.points,
                self.start,
                self.low,
                self.reach_mm,
                distance[part],
                near[part],
            )

        map_threads(find, split_range(len(places)), stage="nearest points")
        return distance, np.append(self.order, len(self.points))[near]


@compiled
def _sort(column: Indices, start: Indices) -> Indices:
    """Indices (N,) of points by column, in their own order within each."""
    free, order = start.copy(), np.empty(len(column), np.int64)
    for n in range(len(column)):
        order[free[column[n]]] = n
        free[column[n]] += 1
    return order


@compiled
def _find(
    places: Array,
    points: Array,
    start: Indices,
    low: Array,
    reach_mm: float,
    distance: Array,
    near: Indices,
) -> None:
    """Fill in distances (M, k) and positions (M, k) in `order` of the nearest points, ascending."""
    most = distance.shape[1]
    height, width = start.shape
    for v in range(len(places)):
        x, y, z = places[v, 0], places[v, 1], places[v, 2]
        row, column = int(np.floor((y - low[0]) / reach_mm)), int(np.floor((z - low[1]) / reach_mm))
        farthest = reach_mm**2
        found = 0
        for j in range(max(row - 1, 0), min(row + 2, height - 1)):
            first, last = max(column - 1, 0), min(column + 2, width - 1)
            if first >= last:
                continue
            for p in range(start[j, first], start[j, last]):
                along = points[p, 0] - x
                if along * along >= farthest:
                    continue
                squared = along * along + (points[p, 1] - y) ** 2 + (points[p, 2] - z) ** 2
                if squared >= farthest:
                    continue
                place = min(found, most - 1)
                while place > 0 and distance[v, place - 1] > squared:
                    distance[v, place], near[v, place] = distance[v, place - 1], near[v, place - 1]
                    place -= 1
                distance[v, place], near[v, place] = squared, p
                found = min(found + 1, most)
                if found == most:
                    farthest = distance[v, most - 1]
        for n in range(found):
            distance[v, n] = np.sqrt(distance[v, n])
