"""Whether a triangle mesh is a closed, oriented, manifold surface, and its number of pieces.

Linear in the number of faces (Open3D's is_watertight also looks for self-intersections and is
quadratic).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from bodyscan.arrays import Array, Floats, Indices
from bodyscan.compiled import compiled
from bodyscan.mesh.half_edges import corner_fans, twins


@dataclass(frozen=True)
class Topology:
    """Properties of a mesh as a surface."""

    closed: bool  # every edge lies in exactly two faces, which run along it in opposite directions
    manifold: bool  # closed, and the faces around every vertex form a single fan
    components: int
    euler: int  # 2 for a sphere, less 2 for each handle
    volume_mm3: float  # signed; positive if the faces are oriented outwards


def topology(vertices: Array, faces: Indices) -> Topology:
    """Topology of a mesh with vertices (V, 3) and faces (F, 3); unused vertices do not count."""
    used = used_vertices(faces, len(vertices))
    count = len(vertices)
    closed, manifold = closed_and_manifold(faces, count)
    edge_count = 3 * len(faces) // 2 if closed else len(np.unique(_edge_keys(faces, count)))
    labels = face_components(faces, count)
    return Topology(
        closed,
        manifold,
        int(labels.max() + 1) if labels.size else 0,
        int(used.size - edge_count + len(faces)),
        signed_volume(vertices, faces),
    )


def closed_and_manifold(faces: Indices, vertex_count: int) -> tuple[bool, bool]:
    """The `closed` and `manifold` of `Topology` for faces (F, 3), without the rest."""
    twin = twins(faces, vertex_count)
    closed = bool(faces.size) and bool((twin >= 0).all())
    return closed, closed and corner_fans(twin)[1] == used_vertices(faces, vertex_count).size


def _edge_keys(faces: Indices, vertex_count: int) -> Indices:
    """A number (3 F,) for each edge, whichever way it runs."""
    low, high = np.sort(directed_edges(faces), axis=1).T
    return low * vertex_count + high


def directed_edges(faces: Indices) -> Indices:
    """Edges (3 F, 2): edge k of face f, at k * F + f, runs from its corner k to the next."""
    return np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])


def face_components(faces: Indices, vertex_count: int) -> NDArray[np.int32]:
    """Number (F,) of the connected piece that each face belongs to."""
    edges = directed_edges(faces)
    graph = coo_array(
        (np.ones(len(edges), np.int8), (edges[:, 0], edges[:, 1])),
        shape=(vertex_count, vertex_count),
    )
    count, labels = connected_components(graph, directed=False)
    own = labels[faces[:, 0]]
    number = np.cumsum(np.bincount(own, minlength=count) > 0, dtype=np.int32) - 1
    return number[own]


def signed_volume(vertices: Array, faces: Indices) -> float:
    """Volume inside a closed mesh, mm^3; negative if its faces are oriented inwards."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return float(np.einsum("fc,fc->", a, np.cross(b, c)) / 6.0)


def face_areas(vertices: Array, faces: Indices) -> Array:
    """Areas (F,) mm^2."""
    return 0.5 * np.linalg.norm(face_normals(vertices, faces), axis=1)


def face_normals(vertices: Array, faces: Indices) -> Array:
    """Normals (F, 3) of faces (F, 3), twice as long as their areas."""
    found = np.empty((len(faces), 3))
    _cross(np.ascontiguousarray(vertices, float), np.ascontiguousarray(faces, np.int64), found)
    return found


@compiled
def _cross(vertices: Array, faces: Indices, found: Array) -> None:
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        for k in range(3):
            i, j = (k + 1) % 3, (k + 2) % 3
            found[f, k] = (vertices[b, i] - vertices[a, i]) * (vertices[c, j] - vertices[a, j])
            found[f, k] -= (vertices[b, j] - vertices[a, j]) * (vertices[c, i] - vertices[a, i])


def vertex_normals(vertices: Array, faces: Indices) -> Floats:
    """Unit normals (V, 3), the area-weighted mean of the faces around each vertex."""
    cross = face_normals(vertices, faces)
    total = np.stack(
        [
            np.bincount(faces.ravel(), np.repeat(cross[:, k], 3), minlength=len(vertices))
            for k in range(3)
        ],
        axis=-1,
    )
    length = np.linalg.norm(total, axis=-1, keepdims=True)
    return (total / np.where(length > 0, length, 1.0)).astype(np.float32)


def drop_unused_vertices(vertices: Array, faces: Indices) -> tuple[Array, Indices, Indices]:
    """Vertices that faces use, the faces renumbered, and the old numbers of those vertices."""
    used = used_vertices(faces, len(vertices))
    number = np.full(len(vertices), -1, np.int64)
    number[used] = np.arange(used.size)
    return vertices[used], number[faces], used


def used_vertices(faces: Indices, count: int) -> Indices:
    """Numbers of the vertices (of `count`) that faces use, ascending."""
    used = np.zeros(count, bool)
    used[faces] = True
    return np.flatnonzero(used)
