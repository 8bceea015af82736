"""Edges and components of triangle meshes, and whether one is a closed manifold.

Linear in the number of faces (Open3D's is_watertight also looks for self-intersections and is
quadratic). Half-edge 3 f + k runs from corner k of face f to the next corner.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from bodyscan.arrays import Array, Floats, Indices
from bodyscan.compiled import compiled

RIM = -1  # no face on the other side
UNSOUND = -2  # several faces run along the edge the same way, or it has no length


def find_twins(faces: Indices, vertex_count: int) -> Indices:
    """Find the opposite half-edge (F, 3) of each half-edge of faces (F, 3), or RIM or UNSOUND."""
    return _twins(np.ascontiguousarray(faces, np.int64).ravel(), vertex_count).reshape(-1, 3)


def label_corner_fans(twin: Indices) -> tuple[Indices, int]:
    """Label (F, 3) each corner with its fan of faces around a vertex; also the number of fans.

    twin: (F, 3), from `find_twins`. The corners of a fan are connected across edges that two faces
    share in opposite directions.
    """
    labels, count = _fans(np.ascontiguousarray(twin).ravel())
    return labels.reshape(-1, 3), int(count)


@compiled
def _twins(corners: Indices, vertex_count: int) -> Indices:
    """Find twins (3 F,) from the faces' corners (3 F,), by the half-edges that leave each vertex."""
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
        for k in range(start[a], start[a + 1]):
            other = leaving[k]
            along += corners[other + 1 if other % 3 < 2 else other - 2] == b
        for k in range(start[b], start[b + 1]):
            other = leaving[k]
            if corners[other + 1 if other % 3 < 2 else other - 2] == a:
                against += 1
                twin[edge] = other
        if along > 1 or against > 1 or a == b:
            twin[edge] = -2
    return twin


@compiled
def _fans(twin: Indices) -> tuple[Indices, int]:
    """Number the fans (3 F,) of the corners, by turning about each vertex."""
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


def find_fault(vertices: Array, faces: Indices) -> str | None:
    """Say what makes vertices (V, 3) and faces (F, 3) no mesh, and where; None if nothing does."""
    bad = np.flatnonzero(~np.isfinite(vertices).all(axis=1))
    if bad.size:
        return (
            f"vertex {bad[0]} has a coordinate that is not a number (of {bad.size} such vertices)"
        )
    wrong = np.argwhere((faces < 0) | (faces >= len(vertices)))
    if wrong.size:
        face, named = wrong[0, 0], faces[tuple(wrong[0])]
        return f"face {face} names vertex {named}, which is not there: {len(vertices)} vertices"
    return None


@dataclass(frozen=True)
class Topology:
    """Properties of a mesh as a surface.

    closed: every edge lies in exactly two faces, which run along it in opposite directions.
    manifold: closed, and the faces around every vertex form a single fan.
    euler: V - E + F: 2 for a sphere, less 2 for each handle.
    volume_mm3: signed; positive if the faces are oriented outwards.
    """

    closed: bool
    manifold: bool
    components: int
    euler: int
    volume_mm3: float


def compute_topology(vertices: Array, faces: Indices) -> Topology:
    """Compute the topology of vertices (V, 3) and faces (F, 3); unused vertices do not count."""
    used, count = used_vertices(faces, len(vertices)), len(vertices)
    closed, manifold = check_manifold(faces, count)
    edge_count = 3 * len(faces) // 2
    if not closed:
        edge_count = len(np.unique(np.sort(directed_edges(faces), axis=1) @ [count, 1]))
    labels = label_components(faces, count)
    return Topology(
        closed,
        manifold,
        int(labels.max() + 1) if labels.size else 0,
        int(used.size - edge_count + len(faces)),
        signed_volume(vertices, faces),
    )


def check_manifold(faces: Indices, vertex_count: int) -> tuple[bool, bool]:
    """Compute the `closed` and `manifold` of `Topology` for faces (F, 3), without the rest."""
    twin = find_twins(faces, vertex_count)
    closed = bool(faces.size) and bool((twin >= 0).all())
    return closed, closed and label_corner_fans(twin)[1] == used_vertices(faces, vertex_count).size


def directed_edges(faces: Indices) -> Indices:
    """List edges (3 F, 2): edge k of face f, at k * F + f, runs from its corner k to the next."""
    return np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])


def connect(edges: Indices, count: int) -> tuple[int, NDArray[np.int32]]:
    """Find the number of connected components of a graph, and the component (count,) of each node.

    edges: (N, 2), pairs of nodes 0 to count - 1.
    """
    graph = coo_array((np.ones(len(edges), np.int8), tuple(edges.T)), shape=(count, count))
    number, labels = connected_components(graph, directed=False)
    return int(number), labels


def label_components(faces: Indices, vertex_count: int) -> NDArray[np.int32]:
    """Label (F,) each face with the number, from 0, of its connected component."""
    count, labels = connect(directed_edges(faces), vertex_count)
    label = labels[faces[:, 0]]
    number = np.cumsum(np.bincount(label, minlength=count) > 0, dtype=np.int32) - 1
    return number[label]


def signed_volume(vertices: Array, faces: Indices) -> float:
    """Compute the volume inside a closed mesh, mm^3; negative if its faces are oriented inwards."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return float(np.einsum("fc,fc->", a, np.cross(b, c)) / 6.0)


def face_areas(vertices: Array, faces: Indices) -> Array:
    """Compute the areas (F,) mm^2 of faces (F, 3)."""
    return 0.5 * np.linalg.norm(face_normals(vertices, faces), axis=1)


def face_normals(vertices: Array, faces: Indices) -> Array:
    """Compute the normals (F, 3) of faces (F, 3), twice as long as their areas."""
    normals = np.empty((len(faces), 3))
    _cross(np.ascontiguousarray(vertices, float), np.ascontiguousarray(faces, np.int64), normals)
    return normals


@compiled
def _cross(vertices: Array, faces: Indices, normals: Array) -> None:
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        for k in range(3):
            i, j = (k + 1) % 3, (k + 2) % 3
            normals[f, k] = (vertices[b, i] - vertices[a, i]) * (vertices[c, j] - vertices[a, j])
            normals[f, k] -= (vertices[b, j] - vertices[a, j]) * (vertices[c, i] - vertices[a, i])


def vertex_normals(vertices: Array, faces: Indices) -> Floats:
    """Compute unit normals (V, 3), the area-weighted mean of the faces around each vertex."""
    cross = face_normals(vertices, faces)
    corners, count = faces.ravel(), len(vertices)
    total = np.stack([np.bincount(corners, np.repeat(n, 3), count) for n in cross.T], axis=-1)
    length = np.linalg.norm(total, axis=-1, keepdims=True)
    return (total / np.where(length > 0, length, 1.0)).astype(np.float32)


def drop_unused_vertices(vertices: Array, faces: Indices) -> tuple[Array, Indices, Indices]:
    """Drop vertices that no face uses: vertices (U, 3), faces renumbered, old indices (U,)."""
    used = used_vertices(faces, len(vertices))
    number = np.full(len(vertices), -1, np.int64)
    number[used] = np.arange(used.size)
    return vertices[used], number[faces], used


def used_vertices(faces: Indices, count: int) -> Indices:
    """Find the indices of the vertices (of `count`) that faces use, ascending."""
    used = np.zeros(count, bool)
    used[faces] = True
    return np.flatnonzero(used)
