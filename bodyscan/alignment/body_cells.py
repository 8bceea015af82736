"""Cells of a few centimetres on a body's surface, and their distances through the body.

Distances run along the surface and straight through what is solid: a hand is far from the thigh
beside it, and the front of an arm is as near its back as the arm is thick.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree

from bodyscan.arrays import Array, Indices
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.progress import THREADS

CELL_MM = 35.0  # a breath bends by a hundredth of a millimetre over half of it
FEWEST_POINTS = 5
NEAR_MM = 55.0  # centres of neighbouring cells are within this
GAP_MM = 15.0  # half of what lies between a hand and a thigh, where nothing was seen
SOME = 4  # of the points show where that gap is
SAME_SIDE = -0.2  # cosine between neighbours' normals: round a finger, not across a gap
STRAIGHT = 0.85  # cosine between the line through a limb and the normals at both ends
THICKEST_MM = 300.0
LANDMARK_MM = 110.0


@dataclass(frozen=True, eq=False)
class BodyCells:
    """C cells of a body's surface, rig frame.

    centres: (C, 3) mm.
    normals: (C, 3).
    links: distances of neighbouring cells, (C, C) mm.
    landmarks: a few cells, (L,).
    away: distances through the body from each landmark to all cells, (L, C) mm.
    """

    centres: Array
    normals: Array
    links: sparse.csr_array
    landmarks: Indices
    away: Array

    @staticmethod
    def of(points: Array, normals: Array) -> tuple[BodyCells, Indices]:
        """Cells of points (N, 3) with normals (N, 3), and each point's cell (N,), -1 for none."""
        centres, turned, cell = _gather(points, normals, CELL_MM, FEWEST_POINTS)
        links = _link(centres, turned, points[::SOME])
        landmarks = one_each(centres, LANDMARK_MM)
        away = _distances(links, landmarks)
        return BodyCells(centres, turned, links, landmarks, away), cell

    def distances(self, starts: Indices) -> Array:
        """Distances through the body from cells (N,) to all others, (N, C) mm."""
        return _distances(self.links, starts)

    def find_many(self, points: Array, normals: Array) -> Indices:
        """The same as `find` for a million points, handled in groups of neighbours."""
        centres, turned, number = _gather(points, normals, 0.4 * CELL_MM, 1)
        return self.find(centres, turned)[number]

    def find(self, points: Array, normals: Array) -> Indices:
        """The cell (N,) of each point (N, 3) with its normal (N, 3), or the nearest one."""
        tree = cKDTree(np.hstack([self.centres, CELL_MM * self.normals]))
        there = tree.query(np.hstack([points, CELL_MM * normals]), workers=THREADS)[1]
        return np.asarray(there, np.int64)

    def alike(self, length_mm: float, least: float) -> Array:
        """Smooth functions (C, M) over the cells whose products sum to the cells' correlation.

        The correlation is exp(-(distance / length)^2 / 2). Functions with less than `least` of the
        first one's variance are dropped.
        """
        closeness = np.exp(-0.5 * (self.away / length_mm) ** 2)
        among = closeness[:, self.landmarks]
        # Distances through a body are not Euclidean: negative eigenvalues are dropped.
        values, vectors = np.linalg.eigh(0.5 * (among + among.T))
        kept = values > least * values[-1]
        return np.asarray(closeness.T @ (vectors[:, kept] / np.sqrt(values[kept])))

    def slopes(self, values: Array) -> Array:
        """Gradients (C, 3, M) along the surface, per mm, of values (C, M)."""
        near = self.links.tocoo()
        beside = near.data < NEAR_MM
        i, j = near.row[beside], near.col[beside]
        step = self.centres[j] - self.centres[i]
        squares = np.zeros((len(self.centres), 3, 3))
        np.add.at(squares, i, step[:, :, None] * step[:, None, :])
        # Across the surface no neighbours determine a slope: take it as zero.
        across = self.normals[:, :, None] * self.normals[:, None, :]
        held = squares + CELL_MM**2 * (4.0 * across + 0.01 * np.eye(3))
        share = np.linalg.solve(held[i], step[:, :, None])[..., 0]
        size = (len(self.centres),) * 2
        slopes = []
        for column in share.T:
            ahead = sparse.csr_array((column, (i, j)), shape=size)
            slopes.append(ahead @ values - np.bincount(i, column, size[0])[:, None] * values)
        return np.stack(slopes, axis=1)


def rigid_fields(cells: BodyCells, centre: Array, arm_mm: float) -> Array:
    """Displacement fields (C, 12, 6): turns by 1 / arm_mm about a centre, and shifts by 1 mm.

    For each cell the displacement (3,) of its centre, then its derivatives along x, y and z.
    """
    off = cells.centres - centre
    fields = np.zeros((len(off), 4, 3, 6))
    for k, axis in enumerate(np.eye(3)):
        fields[:, 0, :, k] = np.cross(axis, off) / arm_mm
        fields[:, 1:, :, k] = np.cross(axis, np.eye(3)) / arm_mm
        fields[:, 0, k, 3 + k] = 1.0
    return fields.reshape(len(off), 12, 6)


def modulated(fields: Array, cells: BodyCells, functions: Array) -> Array:
    """Fields (C, 12, F) times each of the functions (C, M), as (C, 12, M F)."""
    wide = fields.reshape(len(fields), 4, 3, 1, -1)
    out = wide * functions[:, None, None, :, None]
    out[:, 1:] += cells.slopes(functions)[:, :, None, :, None] * wide[:, :1]
    return out.reshape(len(fields), 12, -1)


def displaced(field: Array, off: Array) -> Array:
    """Displacements (N, 3) mm by fields (N, 12) of points `off` (N, 3) their cells' centres."""
    return field[:, :3] + np.einsum("nki,nk->ni", field[:, 3:].reshape(-1, 3, 3), off)


def seen_from(field: Array, rig_from_camera: RigidTransform) -> Array:
    """A field (C, 12) of the rig frame in a camera's frame."""
    turn = rig_from_camera.rotation
    whole = field.reshape(-1, 4, 3) @ turn
    whole[:, 1:] = np.einsum("ka,nki->nai", turn, whole[:, 1:])
    return whole.reshape(-1, 12)


def _distances(links: sparse.csr_array, starts: Indices) -> Array:
    return np.asarray(dijkstra(links, directed=False, indices=starts.astype(np.int32)))


def _gather(
    points: Array, normals: Array, size_mm: float, fewest: int
) -> tuple[Array, Array, Indices]:
    """Means of points in each cube that face alike, if enough; each point's cube or -1."""
    axis = np.argmax(np.abs(normals), axis=1)
    side = 2 * axis + (np.take_along_axis(normals, axis[:, None], axis=1)[:, 0] > 0)
    cube = np.floor((points - points.min(axis=0)) / size_mm).astype(np.int64)
    key = np.ravel_multi_index((*cube.T, side), (*(cube.max(axis=0) + 1), 6))
    count = np.bincount(key)
    enough = np.flatnonzero(count >= min(fewest, count.max()))
    number = np.full(len(count), -1)
    number[enough] = np.arange(len(enough))
    centres, turned = (
        np.stack([np.bincount(key, column)[enough] for column in values.T], axis=1).astype(float)
        for values in (points, normals)
    )
    length = np.maximum(np.linalg.norm(turned, axis=1, keepdims=True), 1e-9)
    return centres / count[enough, None], turned / length, number[key]


def one_each(centres: Array, size_mm: float) -> Indices:
    """The cell nearest to the middle of each cube of that size."""
    place = (centres - centres.min(axis=0)) / size_mm
    cube = np.floor(place).astype(np.int64)
    key = np.ravel_multi_index(tuple(cube.T), tuple(cube.max(axis=0) + 1))
    order = np.lexsort((np.sum((place - cube - 0.5) ** 2, axis=1), key))
    return np.sort(order[np.unique(key[order], return_index=True)[1]])


def _link(centres: Array, normals: Array, points: Array) -> sparse.csr_array:
    """Link neighbours on the surface and opposite sides of what is solid; bridge leftover parts."""
    beside = cKDTree(centres).query_pairs(NEAR_MM, output_type="ndarray")
    beside = beside[np.sum(normals[beside[:, 0]] * normals[beside[:, 1]], axis=1) > SAME_SIDE]
    between = 0.5 * (centres[beside[:, 0]] + centres[beside[:, 1]])
    beside = beside[cKDTree(points).query(between)[0] < GAP_MM]
    ends = np.concatenate([beside, _through(centres, normals)])
    while True:
        links = _graph(centres, ends)
        label = connected_components(links, directed=False)[1].astype(np.int64)
        sizes = np.bincount(label)
        if len(sizes) == 1:
            return links
        small = label == np.argmin(sizes)
        away, nearest = cKDTree(centres[~small]).query(centres[small])
        k = int(np.argmin(away))
        bridge = np.flatnonzero(small)[k], np.flatnonzero(~small)[np.asarray(nearest)[k]]
        ends = np.concatenate([ends, [bridge]])


def _graph(centres: Array, ends: Indices) -> sparse.csr_array:
    ends = np.unique(np.sort(ends, axis=1), axis=0)
    length = np.linalg.norm(centres[ends[:, 0]] - centres[ends[:, 1]], axis=1)
    one = sparse.coo_array((length, tuple(ends.T)), shape=(len(centres),) * 2)
    return (one + one.T).tocsr()


def _through(centres: Array, normals: Array) -> Indices:
    """(N, 2): cells, and for each the nearest one straight behind it that faces the other way."""
    x, n = (values.astype(np.float32) for values in (centres - centres.mean(axis=0), normals))
    depth = np.sum(x * n, axis=1) - x @ n.T  # [j, i]: of j behind i
    square = np.sum(x**2, axis=1)
    apart = np.sqrt(np.maximum(square[:, None] + square - 2.0 * x @ x.T, np.float32(1.0)))
    opposite = (np.minimum(depth, depth.T) > STRAIGHT * apart) & (apart < THICKEST_MM)
    distance = np.where(opposite, apart, np.float32(np.inf))
    nearest = np.argmin(distance, axis=1)
    found = np.flatnonzero(np.any(opposite, axis=1))
    return np.stack([found, nearest[found]], axis=1)
