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

RIM = -1  # no face on the other side
UNSOUND = -2  # several faces run along the edge the same way, or it has no length


def find_twins(faces: Indices, vertex_count: int) -> Indices:
    """Find the opposite half-edge (F, 3) of each half-edge of faces (F, 3), or RIM or UNSOUND."""
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    key = np.minimum(start, end) * vertex_count + np.maximum(start, end)
    order = np.argsort(key)
    first = np.flatnonzero(np.diff(key[order], prepend=-1))
    size = np.diff(first, append=len(key))
    one, other = order[first[size == 2]], order[first[size == 2] + 1]
    opposite = (start[one] == end[other]) & (start[one] != end[one])
    one, other = one[opposite], other[opposite]
    twin = np.full(len(key), UNSOUND)
    twin[order[first[size == 1]]] = RIM
    twin[start == end] = UNSOUND
    twin[one], twin[other] = other, one
    return twin.reshape(-1, 3)


def label_corner_fans(twin: Indices) -> tuple[Indices, int]:
    """Label (F, 3) each corner with its fan of faces around a vertex; also the number of fans.

    twin: (F, 3), from `find_twins`. The corners of a fan are connected across edges that two faces
    share in opposite directions.
    """
    edge = np.flatnonzero(twin >= 0)
    across = twin.ravel()[edge]
    ends = across + np.where(across % 3 < 2, 1, -2)
    count, labels = connect(np.stack([edge, ends], axis=-1), twin.size)
    return labels.reshape(-1, 3).astype(np.int64), count


def find_fault(vertices: Array, faces: Indices) -> str | None:
    """Say what makes vertices (V, 3) and faces (F, 3) no mesh, and where; None if nothing does."""
    bad = np.flatnonzero(~np.isfinite(vertices).all(axis=1))
    if bad.size:
        return f"vertex {bad[0]} has a coordinate that is not a number (of {bad.size} such)"
    wrong = np.argwhere((faces < 0) | (faces >= len(vertices)))
    if wrong.size:
        face, named = wrong[0, 0], faces[tuple(wrong[0])]
        return f"face {face} names vertex {named}, which is not there: {len(vertices)} vertices"
    return None


@dataclass(frozen=True)
class Topology:
    """Properties of a mesh as a surface."""

    closed: bool  # every edge lies in exactly two faces, which run along it in opposite directions
    manifold: bool  # closed, and the faces around every vertex form a single fan
    components: int
    euler: int  # V - E + F: 2 for a sphere, less 2 for each handle
    volume_mm3: float  # signed; positive if the faces are oriented outwards


def compute_topology(vertices: Array, faces: Indices) -> Topology:
    """Compute the topology of vertices (V, 3) and faces (F, 3); unused vertices do not count."""
    used, count = find_used_vertices(faces, len(vertices)), len(vertices)
    closed, manifold = check_manifold(faces, count)
    edge_count = 3 * len(faces) // 2
    if not closed:
        edge_count = len(np.unique(np.sort(list_directed_edges(faces), axis=1) @ [count, 1]))
    labels = label_components(faces, count)
    components, euler = int(labels.max(initial=-1)) + 1, used.size - edge_count + len(faces)
    return Topology(
        closed, manifold, components, int(euler), compute_signed_volume(vertices, faces)
    )


def check_manifold(faces: Indices, vertex_count: int) -> tuple[bool, bool]:
    """Compute the `closed` and `manifold` of `Topology` for faces (F, 3), without the rest."""
    twin = find_twins(faces, vertex_count)
    closed = bool(faces.size) and bool((twin >= 0).all())
    return closed, closed and label_corner_fans(twin)[1] == find_used_vertices(
        faces, vertex_count
    ).size


def list_directed_edges(faces: Indices) -> Indices:
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
    count, labels = connect(list_directed_edges(faces), vertex_count)
    label = labels[faces[:, 0]]
    number = np.cumsum(np.bincount(label, minlength=count) > 0, dtype=np.int32) - 1
    return number[label]


def compute_signed_volume(vertices: Array, faces: Indices) -> float:
    """Compute the volume inside a closed mesh, mm^3; negative if its faces are oriented inwards."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return float(np.einsum("fc,fc->", a, np.cross(b, c)) / 6.0)


def compute_face_areas(vertices: Array, faces: Indices) -> Array:
    """Compute the areas (F,) mm^2 of faces (F, 3)."""
    return 0.5 * np.linalg.norm(compute_face_normals(vertices, faces), axis=1)


def compute_face_normals(vertices: Array, faces: Indices) -> Array:
    """Compute the normals (F, 3) of faces (F, 3), twice as long as their areas."""
    x, y, z = np.ascontiguousarray(vertices.T)
    a, b, c = faces.T
    ux, uy, uz, vx, vy, vz = (w[end] - w[a] for end in (b, c) for w in (x, y, z))
    return np.stack([uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx], axis=1)


def compute_vertex_normals(vertices: Array, faces: Indices) -> Floats:
    """Compute unit normals (V, 3), the area-weighted mean of the faces around each vertex."""
    cross = compute_face_normals(vertices, faces)
    corners, count = faces.ravel(), len(vertices)
    total = np.stack([np.bincount(corners, np.repeat(n, 3), count) for n in cross.T], axis=-1)
    length = np.linalg.norm(total, axis=-1, keepdims=True)
    return (total / np.where(length > 0, length, 1.0)).astype(np.float32)


def drop_unused_vertices(vertices: Array, faces: Indices) -> tuple[Array, Indices, Indices]:
    """Drop vertices that no face uses: vertices (U, 3), faces renumbered, old indices (U,)."""
    used = find_used_vertices(faces, len(vertices))
    number = np.full(len(vertices), -1, np.int64)
    number[used] = np.arange(used.size)
    return vertices[used], number[faces], used


def find_used_vertices(faces: Indices, count: int) -> Indices:
    """Find the indices of the vertices (of `count`) that faces use, ascending."""
    used = np.zeros(count, bool)
    used[faces] = True
    return np.flatnonzero(used)
