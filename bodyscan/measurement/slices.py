"""Where a horizontal plane cuts a mesh: closed loops, their girth, tape girth and area."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, QhullError

from bodyscan.arrays import Array, Indices, Mask


@dataclass(frozen=True, eq=False)
class Loop:
    """One closed curve of a slice, mm.

    segments: (N, 2, 2) from (x, y) to (x, y), in no order, each with the body on its left seen
    from above.  measured: (N,) whether the segment runs across a measured face.
    """

    segments: Array
    measured: Mask

    @property
    def lengths(self) -> Array:
        """(N,) mm."""
        return np.linalg.norm(self.segments[:, 1] - self.segments[:, 0], axis=1)

    @property
    def girth_mm(self) -> float:
        """Along the surface, into every fold."""
        return float(self.lengths.sum())

    @property
    def tape_mm(self) -> float:
        """As a tape runs, straight across hollows: the perimeter of the convex hull."""
        try:
            return float(ConvexHull(self.segments[:, 0]).area)
        except QhullError:  # a speck: all in one line
            return self.girth_mm

    @property
    def area_mm2(self) -> float:
        """Enclosed; negative for the rim of a hollow inside the body."""
        a, b = np.moveaxis(self.segments - self.centre, 1, 0)
        return float(0.5 * np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]))

    @property
    def centre(self) -> Array:
        """(2,) mean of the curve, mm."""
        middles, lengths = self.segments.mean(axis=1), self.lengths
        if not lengths.sum():
            return middles.mean(axis=0)
        return np.average(middles, axis=0, weights=lengths)

    @property
    def measured_share(self) -> float:
        """Of the girth, how much runs across measured faces."""
        return float(self.lengths[self.measured].sum() / max(self.girth_mm, 1e-12))


def loops_at(
    vertices: Array, faces: Indices, height_mm: float, filled: Mask | None = None
) -> tuple[Loop, ...]:
    """The loops of the slice z = height_mm, largest area first; () where the plane misses the mesh.

    vertices (V, 3) mm, faces (F, 3) outward, of a closed mesh; filled (F,) marks made-up faces.
    A vertex that lies exactly in the plane counts as above it, so that loops always close.
    """
    above = (vertices[:, 2] >= height_mm)[faces]
    count = above.sum(axis=1)
    crossed = np.flatnonzero((count == 1) | (count == 2))
    if not crossed.size:
        return ()
    # The corner that is alone on its side of the plane, and the other two after it.
    alone_above = count[crossed] == 1
    lone = np.argmax(above[crossed] == alone_above[:, None], axis=1)
    corner, one, other = (faces[crossed, (lone + k) % 3] for k in range(3))
    start, end = np.where(alone_above, one, other), np.where(alone_above, other, one)
    segments = np.stack([_crossing(vertices, corner, way, height_mm) for way in (start, end)], 1)
    labels = _label_loops(corner, start, end, len(vertices))
    measured = np.ones(crossed.size, bool) if filled is None else ~filled[crossed]
    order = np.argsort(labels, kind="stable")
    parts = np.split(order, np.flatnonzero(np.diff(labels[order])) + 1)
    loops = [Loop(segments[part], measured[part]) for part in parts]
    return tuple(sorted(loops, key=lambda loop: -loop.area_mm2))


def _crossing(vertices: Array, a: Indices, b: Indices, height_mm: float) -> Array:
    """(N, 2) where edges from a to b pass the height; the same from either face of an edge."""
    low, high = vertices[np.minimum(a, b)], vertices[np.maximum(a, b)]
    share = (height_mm - low[:, 2]) / (high[:, 2] - low[:, 2])
    return low[:, :2] + share[:, None] * (high[:, :2] - low[:, :2])


def _label_loops(corner: Indices, start: Indices, end: Indices, count: int) -> Indices:
    """(N,) number of the loop of each segment: neighbours share the edge that they end on."""
    keys = [np.minimum(corner, x) * count + np.maximum(corner, x) for x in (start, end)]
    edges, number = np.unique(np.concatenate(keys), return_inverse=True)
    here, there = np.split(number, 2)
    graph = coo_array((np.ones(len(here), np.int8), (here, there)), shape=(edges.size, edges.size))
    return connected_components(graph, directed=False)[1][here].astype(np.int64)
