"""Horizontal slices of a mesh: closed loops, their girth, tape girth, area and unmeasured gaps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from bodyscan.arrays import Array, Bytes, Indices, Mask
from bodyscan.mesh.body import compute_region_shares, select_regions
from bodyscan.mesh.topology import connect


@dataclass(frozen=True, eq=False)
class MeshSlicer:
    """Cuts a closed mesh at any number of heights.

    vertices: (V, 3) mm. faces: (F, 3), outward.
    filled: (F,) which faces were filled. regions: (F,) of the faces.
    """

    vertices: Array
    faces: Indices
    filled: Mask | None = None
    regions: Bytes | None = None

    @cached_property
    def height_ranges(self) -> tuple[Array, Array]:
        """Lowest and highest z (F,) mm of each face."""
        # Corner by corner: numpy's reduction over rows of three takes ten times as long.
        heights = np.ascontiguousarray(self.vertices[:, 2])
        a, b, c = (heights[self.faces[:, k]] for k in range(3))
        return np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)

    def slice(self, height_mm: float) -> tuple[Loop, ...]:
        """Cut at z = height_mm into loops, largest area first; () if the plane misses the mesh.

        A vertex exactly in the plane counts as above it, so that loops always close.
        """
        low, high = self.height_ranges
        crossed = np.flatnonzero((low < height_mm) & (high >= height_mm))
        if not crossed.size:
            return ()
        segments, ends = _cut(self.vertices, self.faces[crossed], height_mm)
        labels = connect(ends, int(ends.max()) + 1)[1][ends[:, 0]]
        filled = np.zeros(crossed.size, bool) if self.filled is None else self.filled[crossed]
        order = np.argsort(labels, kind="stable")
        loops = [
            Loop(
                segments[part],
                ~filled[part],
                ends[part],
                select_regions(self.regions, crossed[part]),
            )
            for part in np.split(order, np.flatnonzero(np.diff(labels[order])) + 1)
        ]
        return tuple(sorted(loops, key=lambda loop: -loop.area_mm2))


@dataclass(frozen=True, eq=False)
class Loop:
    """One closed curve of a slice, mm.

    segments: (N, 2, 2) from (x, y) to (x, y), unordered; seen from above, the body is on the left.
    measured: (N,) whether the segment crosses a measured face.
    ends: (N, 2), ids of the mesh's edges on which each starts and ends; neighbours share them.
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
        """Girth as a tape measures it, straight across hollows: the convex hull's perimeter."""
        return hull_perimeter(self.segments[:, 0])

    @cached_property
    def area_mm2(self) -> float:
        """Enclosed area, negative for a cavity inside the body."""
        a, b = np.moveaxis(self.segments - self.centre, 1, 0)
        return float(0.5 * np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]))

    @cached_property
    def centre(self) -> Array:
        """Centroid (2,) of the curve, mm."""
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
        return None if self.regions is None else compute_region_shares(self.regions, self.lengths)


@dataclass(frozen=True, eq=False)
class Run:
    """A maximal stretch of a loop that was measured, or was not.

    segments: (N,) indices of the loop's segments, unordered.
    first, last: indices of the segments where it begins and ends.
    """

    measured: bool
    segments: Indices
    first: int
    last: int


def hull_perimeter(points: Array) -> float:
    """Compute the perimeter of the convex hull of points (N, 2)."""
    try:
        return float(ConvexHull(points).area)
    except QhullError:  # a speck, or points on one line
        return 2.0 * float(np.linalg.norm(np.ptp(points, axis=0)))


def split_runs(loop: Loop, min_gap_mm: float = 15.0) -> tuple[Run, ...]:
    """Split a loop into measured and unmeasured runs, in order.

    min_gap_mm: shorter gaps count as measured. Across 15 mm of a limb a straight line is less than
        0.5 mm shorter than the curve.
    """
    nodes, number = np.unique(loop.ends, return_inverse=True)
    ends = number.reshape(-1, 2)
    label = _label_runs(ends, loop.measured, len(nodes))
    lengths = np.bincount(label, loop.lengths)
    measured = loop.measured | (lengths[label] < min_gap_mm)
    if (measured != loop.measured).any():
        label = _label_runs(ends, measured, len(nodes))
    runs = [_make_run(ends, np.flatnonzero(label == k), measured) for k in range(label.max() + 1)]
    begins = {int(ends[run.first, 0]): k for k, run in enumerate(runs)}
    order = [0]
    while len(order) < len(runs):
        order.append(begins[int(ends[runs[order[-1]].last, 1])])
    return tuple(runs[k] for k in order)


def join_runs(loop: Loop, runs: Sequence[Run]) -> Loop:
    """Close some runs of a loop to a new loop, by straight unmeasured segments between them."""
    here = np.array([run.last for run in runs])
    there = np.array([run.first for run in [*runs[1:], runs[0]]])
    gap = loop.ends[here, 1] != loop.ends[there, 0]
    here, there = here[gap], there[gap]
    kept = np.concatenate([run.segments for run in runs])
    bridges = np.stack([loop.segments[here, 1], loop.segments[there, 0]], axis=1)
    bridge_ends = np.stack([loop.ends[here, 1], loop.ends[there, 0]], axis=1)
    return Loop(
        np.concatenate([loop.segments[kept], bridges]),
        np.concatenate([loop.measured[kept], np.zeros(len(bridges), bool)]),
        np.concatenate([loop.ends[kept], bridge_ends]),
        select_regions(loop.regions, np.concatenate([kept, np.full(len(bridges), -1)])),
    )


def _make_run(ends: Indices, segments: Indices, measured: Mask) -> Run:
    """Make a run of these segments (N,). A whole loop begins and ends anywhere."""
    first = segments[~np.isin(ends[segments, 0], ends[segments, 1])]
    last = segments[~np.isin(ends[segments, 1], ends[segments, 0])]
    if not (first.size and last.size):
        first, last = segments[:1], segments[ends[segments, 1] == ends[segments[0], 0]]
    return Run(bool(measured[segments[0]]), segments, int(first[0]), int(last[0]))


def _label_runs(ends: Indices, measured: Mask, count: int) -> Indices:
    """Label each segment, with ends (N, 2) at `count` nodes, with the number (N,) of its run."""
    split = ends + count * ~measured[:, None]  # measured and unmeasured segments share no nodes
    labels = connect(split, 2 * count)[1]
    return np.unique(labels[split[:, 0]], return_inverse=True)[1]


def _cut(vertices: Array, faces: Indices, height_mm: float) -> tuple[Array, Indices]:
    """Cut the crossed faces to segments (N, 2, 2), with ids (N, 2) of the edges on which they end."""
    above = (vertices[:, 2] >= height_mm)[faces]
    # The corner that is alone on its side of the plane, and the other two after it.
    alone_above = above.sum(axis=1) == 1
    lone = np.argmax(above == alone_above[:, None], axis=1)
    row = np.arange(len(faces))
    corner, one, other = (faces[row, (lone + k) % 3] for k in range(3))
    start, end = np.where(alone_above, one, other), np.where(alone_above, other, one)
    segments = np.stack([_intersect(vertices, corner, x, height_mm) for x in (start, end)], axis=1)
    count = len(vertices)
    keys = [np.minimum(corner, x) * count + np.maximum(corner, x) for x in (start, end)]
    _, ids = np.unique(np.stack(keys, axis=-1), return_inverse=True)
    return segments, ids.reshape(-1, 2).astype(np.int64)


def _intersect(vertices: Array, a: Indices, b: Indices, height_mm: float) -> Array:
    """Intersect edges from a to b with the height: points (N, 2), identical from either face."""
    low, high = vertices[np.minimum(a, b)], vertices[np.maximum(a, b)]
    share = (height_mm - low[:, 2]) / (high[:, 2] - low[:, 2])
    return low[:, :2] + share[:, None] * (high[:, :2] - low[:, :2])
