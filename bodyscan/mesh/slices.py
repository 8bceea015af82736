"""Horizontal slices of a mesh: closed loops, their girth, tape girth, area and unmeasured gaps."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import depth_first_order
from scipy.spatial import ConvexHull, QhullError

from bodyscan.arrays import Array, Indices, Mask


@dataclass(frozen=True, eq=False)
class MeshSlicer:
    """Cuts a closed mesh at any number of heights."""

    vertices: Array  # (V, 3) mm
    faces: Indices  # (F, 3), outward
    filled: Mask | None = None  # (F,) which faces were filled

    @cached_property
    def height_ranges(self) -> tuple[Indices, Array, Array]:
        """Face indices (F,) sorted by lowest z, and the lowest and highest z (F,), mm, in order."""
        # Corner by corner: numpy's reduction over rows of three takes ten times as long.
        heights = np.ascontiguousarray(self.vertices[:, 2])
        a, b, c = (heights[self.faces[:, k]] for k in range(3))
        low, high = np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)
        order = np.argsort(low)
        return order, low[order], high[order]

    @cached_property
    def tallest_mm(self) -> float:
        """Height of the tallest face."""
        _, low, high = self.height_ranges
        return float((high - low).max(initial=0.0))

    def slice(self, height_mm: float) -> tuple[Loop, ...]:
        """Cut at z = height_mm into loops, largest area first; () if the plane misses the mesh.

        A vertex exactly in the plane counts as above it, so that loops always close.
        """
        order, low, high = self.height_ranges
        some = slice(*np.searchsorted(low, [height_mm - self.tallest_mm, height_mm]))
        crossed = np.sort(order[some][high[some] >= height_mm])
        if not crossed.size:
            return ()
        segments, ends = _cut(self.vertices, self.faces[crossed], height_mm)
        filled = np.zeros(crossed.size, bool) if self.filled is None else self.filled[crossed]
        loops = [Loop(segments[part], ~filled[part], crossed[part]) for part in _follow(ends)]
        return tuple(sorted(loops, key=lambda loop: -loop.area_mm2))


@dataclass(frozen=True, eq=False)
class Loop:
    """One closed curve of a slice, mm."""

    # (N, 2, 2) from (x, y) to (x, y), each from where the one before ends; seen from above, the
    # body is on the left.
    segments: Array
    measured: Mask  # (N,) whether the segment crosses a measured face
    faces: Indices  # (N,) of the mesh; -1 for segments that close a gap

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
        return compute_hull_perimeter(self.segments[:, 0])

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


def compute_hull_perimeter(points: Array) -> float:
    """Compute the perimeter of the convex hull of points (N, 2)."""
    try:
        return float(ConvexHull(points).area)
    except QhullError:  # a speck, or points on one line
        return 2.0 * float(np.linalg.norm(np.ptp(points, axis=0)))


def split_runs(loop: Loop, min_gap_mm: float = 15.0) -> tuple[Mask, list[Indices]]:
    """Split a loop into measured and unmeasured runs: which are measured, and the segments of each.

    min_gap_mm: shorter gaps count as measured. Across 15 mm of a limb a straight line is less than
        0.5 mm shorter than the curve.
    """
    measured = loop.measured.copy()
    for run in _split_equal_runs(measured):
        measured[run] |= loop.lengths[run].sum() < min_gap_mm
    runs = _split_equal_runs(measured)
    return np.array([measured[run[0]] for run in runs]), runs


def _split_equal_runs(labels: Indices | Mask) -> list[Indices]:
    """Indices of each stretch of equal labels (N,) around a closed curve, in order."""
    begins = np.flatnonzero(labels != np.roll(labels, 1))
    if not begins.size:
        return [np.arange(len(labels))]
    return np.split(np.roll(np.arange(len(labels)), -begins[0]), np.cumsum(np.diff(begins)))


def keep_segments(loop: Loop, kept: Mask) -> Loop:
    """Make a loop of some of a loop's segments, closed by straight unmeasured segments between them."""
    index = np.flatnonzero(kept)
    here, there = loop.segments[index, 1], loop.segments[np.roll(index, -1), 0]
    gap = np.flatnonzero((here != there).any(axis=1))
    bridges = np.stack([here[gap], there[gap]], axis=1)
    segments = np.insert(loop.segments[index], gap + 1, bridges, axis=0)
    measured = np.insert(loop.measured[index], gap + 1, False)
    return Loop(segments, measured, np.insert(loop.faces[index], gap + 1, -1))


def _follow(ends: Indices) -> list[Indices]:
    """Indices of the segments of each closed curve, in order, from the ids of their ends (N, 2)."""
    start, end = np.argsort(ends[:, 0], kind="stable"), np.argsort(ends[:, 1], kind="stable")
    following = np.empty(len(ends), np.int64)
    following[end] = start  # every id is the start of one segment, and the end of one
    graph = coo_array((np.ones(len(ends)), (np.arange(len(ends)), following))).tocsr()
    left, curves = np.ones(len(ends), bool), []
    while left.any():
        first = int(np.argmax(left))
        curves.append(depth_first_order(graph, first, return_predecessors=False).astype(np.int64))
        left[curves[-1]] = False
    return curves


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
