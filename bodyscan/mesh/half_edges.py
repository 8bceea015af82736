"""Which face lies across each edge of a triangle mesh.

Half-edge 3 f + k runs from corner k of face f to the next one.
"""

from __future__ import annotations

import numpy as np

from bodyscan.arrays import Indices
from bodyscan.compiled import compiled

RIM = -1  # no face lies across
UNSOUND = -2  # several faces run along the edge the same way, or it has no length


def twins(faces: Indices, vertex_count: int) -> Indices:
    """The half-edge (F, 3) that runs the opposite way along each one, RIM or UNSOUND."""
    return _twins(np.ascontiguousarray(faces, np.int64).ravel(), vertex_count).reshape(-1, 3)


def corner_fans(twin: Indices) -> tuple[Indices, int]:
    """Number of the fan (F, 3) that each corner belongs to, and the number of fans; twin: (F, 3).

    The corners of a fan are connected across edges that two faces share in opposite directions.
    """
    labels, count = _fans(np.ascontiguousarray(twin).ravel())
    return labels.reshape(-1, 3), int(count)


@compiled
def _twins(corners: Indices, vertex_count: int) -> Indices:
    """Twins (3 F,) from the faces' corners (3 F,), by the half-edges that leave each vertex."""
    size = len(corners)
    start = np.zeros(vertex_count + 1, np.int64)
    for vertex in corners:
        start[vertex + 1] += 1
    start = np.cumsum(start)
    leaving, free = np.empty(size, np.int64), start.copy()
    for edge in range(size):
        leaving[free[corners[edge]]] = edge
        free[corners[edge]] += 1
    twin = np.full(size, -1, np.int64)
    for edge in range(size):
        a, b = corners[edge], corners[edge + 1 if edge % 3 < 2 else edge - 2]
        along, against = 0, 0
        for place in range(start[a], start[a + 1]):
            other = leaving[place]
            along += corners[other + 1 if other % 3 < 2 else other - 2] == b
        for place in range(start[b], start[b + 1]):
            other = leaving[place]
            if corners[other + 1 if other % 3 < 2 else other - 2] == a:
                against += 1
                twin[edge] = other
        if along > 1 or against > 1 or a == b:
            twin[edge] = -2
    return twin


@compiled
def _fans(twin: Indices) -> tuple[Indices, int]:
    """Fans (3 F,) of the corners, numbered as found, by turning about each vertex."""
    labels = np.full(len(twin), -1, np.int64)
    count = 0
    for first in range(len(twin)):
        if labels[first] >= 0:
            continue
        corner = first
        while corner >= 0 and labels[corner] < 0:
            labels[corner] = count
            corner = twin[corner - 1 if corner % 3 > 0 else corner + 2]
        # At a rim, turn the other way from the first corner as well.
        across = twin[first]
        while across >= 0:
            corner = across + 1 if across % 3 < 2 else across - 2
            if labels[corner] >= 0:
                break
            labels[corner] = count
            across = twin[corner]
        count += 1
    return labels, count
