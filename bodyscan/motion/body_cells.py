"""Cells of a few centimetres on a body's surface, and geodesic distances between them.

Distances run along the surface and straight through what is solid: a hand is far from the thigh next
to it, and the front of an arm is as near its back as the arm is thick.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree

from bodyscan.arrays import Array, Indices
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.progress import THREADS, background

CELL_MM = 35.0  # breath bends a surface by a hundredth of a millimetre over half of it
NEIGHBOUR_MM = 55.0  # centres of neighbouring cells are within this


@dataclass(frozen=True, eq=False)
class BodyCells:
    """C cells of a body's surface, rig frame."""

    centres: Array  # (C, 3) mm
    normals: Array  # (C, 3)
    graph: sparse.csr_array  # distances of neighbouring cells, (C, C) mm
    landmarks: Indices  # a few cells, (L,)
    landmark_distances: Array  # geodesic distances from each landmark to all cells, (L, C) mm

    @staticmethod
    def from_points(points: Array, normals: Array) -> tuple[BodyCells, Indices]:
        """Divide points (N, 3) with normals (N, 3) into cells.

        Also returns each point's cell (N,), -1 for points in cells with fewer than five.
        """
        centres, mean_normals, cell = _average_in_cubes(points, normals, CELL_MM, 5)
        graph = _build_graph(centres, mean_normals, points[::4])
        landmarks = pick_one_per_cube(centres, 110.0)
        distances = _compute_geodesic_distances(graph, landmarks)
        return BodyCells(centres, mean_normals, graph, landmarks, distances), cell

    def distances(self, starts: Indices) -> Array:
        """Geodesic distances from cells (N,) to all cells, (N, C) mm."""
        return _compute_geodesic_distances(self.graph, starts)

    def find(self, points: Array, normals: Array) -> Indices:
        """Nearest cell (N,) of points (N, 3) with normals (N, 3), by position and orientation."""
        tree = cKDTree(np.hstack([self.centres, CELL_MM * self.normals]))
        nearest = tree.query(np.hstack([points, CELL_MM * normals]), workers=THREADS)[1]
        return np.asarray(nearest, np.int64)

    def find_by_groups(self, points: Array, normals: Array) -> Indices:
        """`find` for a million points, looked up once for each group of neighbours."""
        centres, mean_normals, number = _average_in_cubes(points, normals, 0.4 * CELL_MM, 1)
        return self.find(centres, mean_normals)[number]

    def covariance_factor(self, length_mm: float, min_share: float) -> Array:
        """Low-rank factor L (C, M) of the cells' squared-exponential covariance, L L^T.

        The covariance is exp(-(distance / length)^2 / 2), reduced to the landmarks (Nystroem).
        Eigenvalues below `min_share` of the largest are dropped; so are negative ones, since
        geodesic distances are not Euclidean.
        """
        to_landmarks = np.exp(-0.5 * (self.landmark_distances / length_mm) ** 2)
        among = to_landmarks[:, self.landmarks]
        eigenvalues, eigenvectors = np.linalg.eigh(0.5 * (among + among.T))
        kept = eigenvalues > min_share * eigenvalues[-1]
        return np.asarray(to_landmarks.T @ (eigenvectors[:, kept] / np.sqrt(eigenvalues[kept])))

    def gradients(self, values: Array) -> Array:
        """Gradients (C, 3, M) along the surface, per mm, of values (C, M), by least squares."""
        return np.stack([operator @ values for operator in self._gradient_operators], axis=1)

    @cached_property
    def _gradient_operators(self) -> list[sparse.csr_array]:
        """Matrices (C, C), per mm, from a cell's and its neighbours' values to slopes by x, y, z."""
        graph = self.graph.tocoo()
        adjacent = graph.data < NEIGHBOUR_MM
        i, j = graph.row[adjacent], graph.col[adjacent]
        step = self.centres[j] - self.centres[i]
        squares = np.zeros((len(self.centres), 3, 3))
        np.add.at(squares, i, step[:, :, None] * step[:, None, :])
        # Neighbours determine no slope along the normal: regularize it to zero.
        normal = self.normals[:, :, None] * self.normals[:, None, :]
        inverse = np.linalg.inv(squares + CELL_MM**2 * (4.0 * normal + 0.01 * np.eye(3)))
        weights = np.einsum("eij,ej->ie", inverse[i], step)
        size = (len(self.centres),) * 2
        return [
            sparse.csr_array((row, (i, j)), shape=size)
            - sparse.diags_array(np.bincount(i, row, size[0]), format="csr", dtype=np.float64)
            for row in weights
        ]


def build_rigid_fields(cells: BodyCells, centre: Array, lever_mm: float) -> Array:
    """Fields (C, 12, 6) of rotations by 1 / lever_mm about a centre and translations by 1 mm.

    A field holds, for each cell, the displacement (3,) of its centre, then the displacement's
    derivatives by x, y and z.
    """
    offsets = cells.centres - centre
    fields = np.zeros((len(offsets), 4, 3, 6))
    for k, axis in enumerate(np.eye(3)):
        fields[:, 0, :, k] = np.cross(axis, offsets) / lever_mm
        fields[:, 1:, :, k] = np.cross(axis, np.eye(3)) / lever_mm
        fields[:, 0, k, 3 + k] = 1.0
    return fields.reshape(len(offsets), 12, 6)


def modulate_fields(fields: Array, cells: BodyCells, functions: Array) -> Array:
    """Multiply fields (C, 12, F) by each scalar function (C, M), by the product rule: (C, 12, M F)."""
    wide = fields.reshape(len(fields), 4, 3, 1, -1)
    out = wide * functions[:, None, None, :, None]
    out[:, 1:] += cells.gradients(functions)[:, :, None, :, None] * wide[:, :1]
    return out.reshape(len(fields), 12, -1)


def evaluate_field(field: Array, offsets: Array) -> Array:
    """Displacements (N, 3) mm, by fields (N, 12), of points at `offsets` (N, 3) from their cells."""
    gradients = field[:, 3:].reshape(-1, 3, 3)
    return field[:, :3] + np.einsum("nki,nk->ni", gradients, offsets)


def express_in_camera(field: Array, rig_from_camera: RigidTransform) -> Array:
    """Express a field (C, 12) of the rig frame in the camera frame."""
    rotation = rig_from_camera.rotation
    rotated = field.reshape(-1, 4, 3) @ rotation
    rotated[:, 1:] = np.einsum("ka,nki->nai", rotation, rotated[:, 1:])
    return rotated.reshape(-1, 12)


def pick_one_per_cube(centres: Array, size_mm: float) -> Indices:
    """Indices of the point nearest to the middle of each occupied cube of that size."""
    position = (centres - centres.min(axis=0)) / size_mm
    cube = np.floor(position).astype(np.int64)
    key = np.ravel_multi_index(tuple(cube.T), tuple(cube.max(axis=0) + 1))
    order = np.lexsort((np.sum((position - cube - 0.5) ** 2, axis=1), key))
    return np.sort(order[np.unique(key[order], return_index=True)[1]])


def _compute_geodesic_distances(graph: sparse.csr_array, starts: Indices) -> Array:
    # Each edge is stored in both directions: undirected, each would be tried twice.
    return np.asarray(dijkstra(graph, directed=True, indices=starts.astype(np.int32)))


def _average_in_cubes(
    points: Array, normals: Array, size_mm: float, min_points: int
) -> tuple[Array, Array, Indices]:
    """Mean points and normals in each cube and main direction of the normals, if enough. Also returns
    each point's group, or -1."""
    axis = np.argmax(np.abs(normals), axis=1)
    side = 2 * axis + (np.take_along_axis(normals, axis[:, None], axis=1)[:, 0] > 0)
    # Column by column: along an axis of three numpy takes five times as long.
    cube = [((column - column.min()) / size_mm).astype(np.int64) for column in points.T]
    key = np.ravel_multi_index((*cube, side), (*(column.max() + 1 for column in cube), 6))
    count = np.bincount(key)
    enough = np.flatnonzero(count >= min(min_points, count.max()))
    number = np.full(len(count), -1)
    number[enough] = np.arange(len(enough))
    point_sum, normal_sum = (
        np.stack([np.bincount(key, column)[enough] for column in values.T], axis=1).astype(float)
        for values in (points, normals)
    )
    length = np.maximum(np.linalg.norm(normal_sum, axis=1, keepdims=True), 1e-9)
    return point_sum / count[enough, None], normal_sum / length, number[key]


def _build_graph(centres: Array, normals: Array, points: Array) -> sparse.csr_array:
    """Connect neighbours on the surface, and opposite sides of what is solid.

    points: of the surface. Components that remain are bridged where they are nearest.
    """
    with background() as other:
        opposite = other.submit(_find_opposite_cells, centres, normals)
        edges = cKDTree(centres).query_pairs(NEIGHBOUR_MM, output_type="ndarray")
        (x, y), (n, m) = (values[edges.T] for values in (centres, normals))
        step, cosine = y - x, np.sum(n * m, axis=1)
        # Neighbours round a finger, not across a gap, nor a forearm and the flank that it touches:
        # in a hollow with a radius of 80 mm the next cell is so far in front of a cell's plane.
        in_front = np.maximum(np.sum(step * n, axis=1), -np.sum(step * m, axis=1))
        same = (cosine > -0.2) & (in_front < np.sum(step**2, axis=1) / 160.0)
        # Half the gap between a hand and a thigh, in which nothing was measured.
        edges = edges[same & (cKDTree(points).query(0.5 * (x + y))[0] < 15.0)]
        edges = np.concatenate([edges, opposite.result()])
    while True:
        graph = _build_weighted_graph(centres, edges)
        label = connected_components(graph, directed=False)[1].astype(np.int64)
        sizes = np.bincount(label)
        if len(sizes) == 1:
            return graph
        smallest = label == np.argmin(sizes)
        distance, nearest = cKDTree(centres[~smallest]).query(centres[smallest])
        k = int(np.argmin(distance))
        bridge = np.flatnonzero(smallest)[k], np.flatnonzero(~smallest)[np.asarray(nearest)[k]]
        edges = np.concatenate([edges, [bridge]])


def _build_weighted_graph(centres: Array, edges: Indices) -> sparse.csr_array:
    """Symmetric graph (C, C) with the lengths of edges (N, 2), mm."""
    edges = np.unique(np.sort(edges, axis=1), axis=0)
    length = np.linalg.norm(centres[edges[:, 0]] - centres[edges[:, 1]], axis=1)
    upper = sparse.coo_array((length, tuple(edges.T)), shape=(len(centres),) * 2)
    return (upper + upper.T).tocsr()


def _find_opposite_cells(centres: Array, normals: Array) -> Indices:
    """(N, 2): cells, and for each the nearest cell straight behind it that faces the other way.

    Within 300 mm, the thickest trunk; straight is a cosine of 0.85 between the line through the
    limb and the normals at both ends. Not the far side of a thigh behind a hand: others are nearer it.
    """
    x, n = (values.astype(np.float32) for values in (centres - centres.mean(axis=0), normals))
    depth = np.sum(x * n, axis=1) - x @ n.T  # [j, i]: of j behind i
    square = np.sum(x**2, axis=1)
    distance = np.sqrt(np.maximum(square[:, None] + square - 2.0 * x @ x.T, np.float32(1.0)))
    opposite = (np.minimum(depth, depth.T) > 0.85 * distance) & (distance < 300.0)
    distance[~opposite] = np.inf
    nearest, shortest = np.argmin(distance, axis=1), np.min(distance, axis=1)
    found = np.flatnonzero(np.any(opposite, axis=1) & (shortest < 1.2 * shortest[nearest]))
    return np.stack([found, nearest[found]], axis=1)
