"""Horizontal slices of a mesh: closed loops, their girth, tape girth and area."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, QhullError

from bodyscan.arrays import Array, Bytes, Indices, Mask
from bodyscan.mesh.regions import regions_at, shares

SHORTEST_GAP_MM = 15.0
"""A straight line across a shorter gap on a limb is less than 0.5 mm shorter than the curve."""


@dataclass(frozen=True, eq=False)
class Loop:
    """One closed curve of a slice, mm.

    segments: (N, 2, 2) from (x, y) to (x, y), unordered, each with the body on its left seen from
        above.
    measured: (N,) whether the segment crosses a measured face.
    ends: (N, 2), numbers of the mesh's edges where each starts and ends; neighbours share them.
    regions: (N,) of the faces, if known.
    """

    segments: Array
    measured: Mask
    ends: Indices
    regions: Bytes | None = None

    @cached_property
    def lengths(self) -> Array:
        """Length of each segment (N,) mm."""
        return np.linalg.norm(self.segments[:, 1] - self.segments[:, 0], axis=1)

    @property
    def girth_mm(self) -> float:
        """Girth along the surface, into every fold."""
        return float(self.lengths.sum())

    @property
    def tape_mm(self) -> float:
        """Girth as a tape runs, straight across hollows: the perimeter of the convex hull."""
        return hull_mm(self.segments[:, 0])

    @cached_property
    def area_mm2(self) -> float:
        """Enclosed area; negative for the rim of a hollow inside the body."""
        a, b = np.moveaxis(self.segments - self.centre, 1, 0)
        return float(0.5 * np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]))

    @cached_property
    def centre(self) -> Array:
        """Mean (2,) of the curve, mm."""
        middles, lengths = self.segments.mean(axis=1), self.lengths
        if not lengths.sum():
            return middles.mean(axis=0)
        return np.average(middles, axis=0, weights=lengths)

    @property
    def measured_share(self) -> float:
        """Share of the girth that crosses measured faces."""
        return float(self.lengths[self.measured].sum() / max(self.girth_mm, 1e-12))

    @property
    def region_shares(self) -> dict[str, float] | None:
        """Share of the girth that crosses each region, by name."""
        return None if self.regions is None else shares(self.regions, self.lengths)


@dataclass(frozen=True, eq=False)
class Run:
    """A stretch of a loop that was measured, or was not.

    segments: (N,) which of the loop's, unordered.
    first, last: the segments where it begins and ends.
    """

    measured: bool
    segments: Indices
    first: int
    last: int


def hull_mm(points: Array) -> float:
    """Perimeter of the convex hull of points (N, 2)."""
    try:
        return float(ConvexHull(points).area)
    except QhullError:  # a speck, or points on one line
        return 2.0 * float(np.linalg.norm(np.ptp(points, axis=0)))


def runs_of(loop: Loop, shortest_gap_mm: float) -> tuple[Run, ...]:
    """A loop's stretches in order; unmeasured ones shorter than `shortest_gap_mm` count as
    measured."""
    nodes, number = np.unique(loop.ends, return_inverse=True)
    ends = number.reshape(-1, 2)
    label = _stretches(ends, loop.measured, len(nodes))
    lengths = np.bincount(label, loop.lengths)
    measured = loop.measured | (lengths[label] < shortest_gap_mm)
    if (measured != loop.measured).any():
        label = _stretches(ends, measured, len(nodes))
    runs = [_run(ends, np.flatnonzero(label == k), measured) for k in range(label.max() + 1)]
    begins = {int(ends[run.first, 0]): k for k, run in enumerate(runs)}
    order = [0]
    while len(order) < len(runs):
        order.append(begins[int(ends[runs[order[-1]].last, 1])])
    return tuple(runs[k] for k in order)


def joined(loop: Loop, runs: Sequence[Run]) -> Loop:
    """A loop made of stretches of another one, with straight connections from each to the next."""
    following = [*runs[1:], runs[0]]
    here = np.array([run.last for run in runs])
    there = np.array([run.first for run in following])
    apart = loop.ends[here, 1] != loop.ends[there, 0]
    here, there = here[apart], there[apart]
    own = np.concatenate([run.segments for run in runs])
    across = np.stack([loop.segments[here, 1], loop.segments[there, 0]], axis=1)
    numbers = np.stack([loop.ends[here, 1], loop.ends[there, 0]], axis=1)
    return Loop(
        np.concatenate([loop.segments[own], across]),
        np.concatenate([loop.measured[own], np.zeros(len(across), bool)]),
        np.concatenate([loop.ends[own], numbers]),
        regions_at(loop.regions, np.concatenate([own, np.full(len(across), -1)])),
    )


def _run(ends: Indices, own: Indices, measured: Mask) -> Run:
    """A stretch of the segments `own`. A whole loop begins and ends anywhere."""
    first = own[~np.isin(ends[own, 0], ends[own, 1])]
    last = own[~np.isin(ends[own, 1], ends[own, 0])]
    if not (first.size and last.size):
        first, last = own[:1], own[ends[own, 1] == ends[own[0], 0]]
    return Run(bool(measured[own[0]]), own, int(first[0]), int(last[0]))


def _stretches(ends: Indices, measured: Mask, count: int) -> Indices:
    """Numbers (N,) from 0 of the stretches of segments (N, 2) that were measured, or were not."""
    own = ends + count * ~measured[:, None]  # unmeasured segments get nodes of their own
    graph = coo_array((np.ones(len(own), np.int8), tuple(own.T)), shape=(2 * count, 2 * count))
    nodes = connected_components(graph, directed=False)[1]
    return np.unique(nodes[own[:, 0]], return_inverse=True)[1]


def loops_at(
    vertices: Array,
    faces: Indices,
    height_mm: float,
    filled: Mask | None = None,
    regions: Bytes | None = None,
) -> tuple[Loop, ...]:
    """The loops of the slice z = height_mm, largest area first; () if the plane misses the mesh.

    vertices: (V, 3) mm, of a closed mesh.
    faces: (F, 3), outward.
    filled: (F,) which faces are filled.
    regions: (F,) of the faces.

    A vertex exactly in the plane counts as above it, so that loops always close.
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
    ends = _edge_numbers(corner, start, end, len(vertices))
    labels = _label_loops(ends)
    measured = np.ones(crossed.size, bool) if filled is None else ~filled[crossed]
    order = np.argsort(labels, kind="stable")
    parts = np.split(order, np.flatnonzero(np.diff(labels[order])) + 1)
    loops = [
        Loop(segments[part], measured[part], ends[part], regions_at(regions, crossed[part]))
        for part in parts
    ]
    return tuple(sorted(loops, key=lambda loop: -loop.area_mm2))


def height_ranges(vertices: Array, faces: Indices) -> tuple[Array, Array]:
    """Lowest and highest z of each face, (F,) mm: a slice needs only the faces that it crosses.

    Corner by corner: numpy's reduction over rows of three takes ten times as long.
    """
    heights = np.ascontiguousarray(vertices[:, 2])
    a, b, c = (heights[faces[:, k]] for k in range(3))
    return np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)


def _crossing(vertices: Array, a: Indices, b: Indices, height_mm: float) -> Array:
    """Points (N, 2) where edges from a to b pass the height;
    identical from either face of an edge."""
    low, high = vertices[np.minimum(a, b)], vertices[np.maximum(a, b)]
    share = (height_mm - low[:, 2]) / (high[:, 2] - low[:, 2])
    return low[:, :2] + share[:, None] * (high[:, :2] - low[:, :2])


def _edge_numbers(corner: Indices, start: Indices, end: Indices, count: int) -> Indices:
    """Numbers (N, 2), from 0, of the mesh's edges on which segments start and end."""
    keys = [np.minimum(corner, x) * count + np.maximum(corner, x) for x in (start, end)]
    _, number = np.unique(np.stack(keys, axis=-1), return_inverse=True)
    return number.reshape(-1, 2).astype(np.int64)


def _label_loops(ends: Indices) -> Indices:
    """Number (N,) of each segment's loop: neighbours share the edge on which they end."""
    size = int(ends.max()) + 1
    graph = coo_array((np.ones(len(ends), np.int8), tuple(ends.T)), shape=(size, size))
    return connected_components(graph, directed=False)[1][ends[:, 0]].astype(np.int64)
