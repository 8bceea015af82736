"""Turning a nearly closed triangle mesh into a closed manifold."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from bodyscan.arrays import Array, Indices
from bodyscan.mesh.half_edges import RIM, UNSOUND, corner_fans, twins
from bodyscan.mesh.topology import (
    drop_unused_vertices,
    face_components,
    signed_volume,
    used_vertices,
)


def close_mesh(vertices: Array, faces: Indices) -> tuple[Array, Indices]:
    """Vertices (V, 3) and faces (F, 3) of a closed manifold surface made from a nearly closed one.

    Faces at edges shared by more than two are removed, surfaces that touch in a vertex are
    separated, holes are closed with fans of triangles. An octree's surface has a few such places; a
    closed manifold is unchanged, except for the numbers of its vertices.
    """
    twin = twins(faces, len(vertices))
    sound = (twin != UNSOUND).all(axis=1)
    if not sound.all():
        faces = faces[sound]
        twin = twins(faces, len(vertices))
    parted, count = corner_fans(twin)
    places = np.empty((count, 3))
    places[parted] = vertices[faces]
    following = np.roll(parted, -1, axis=1)
    return _fill_holes(
        places, parted, np.stack([parted[twin == RIM], following[twin == RIM]], axis=-1)
    )


def _fill_holes(vertices: Array, faces: Indices, rim: Indices) -> tuple[Array, Indices]:
    """Close every rim, given by edges (N, 2), with a vertex
    at its middle and a triangle per edge."""
    if not len(rim):
        return vertices, faces
    corners, ends = np.unique(rim, return_inverse=True)
    ends = ends.reshape(-1, 2)
    graph = coo_array((np.ones(len(rim), np.int8), tuple(ends.T)), shape=(len(corners),) * 2)
    _, piece = connected_components(graph, directed=False)
    hole = piece[ends[:, 0]]
    size = np.bincount(hole)
    middles = np.stack(
        [np.bincount(hole, vertices[rim[:, 0], axis]) / size for axis in range(3)], axis=-1
    )
    fans = np.stack([rim[:, 1], rim[:, 0], len(vertices) + hole], axis=-1)
    return np.concatenate([vertices, middles]), np.concatenate([faces, fans])


def largest_piece(
    vertices: Array, faces: Indices, points: Array | None = None
) -> tuple[Array, Indices]:
    """The connected piece with the most faces, closed and oriented outwards.

    points: (N, 3); choose the piece next to most of these instead: what closes the surface behind a
        wall may have more faces than what was scanned before it.
    """
    vertices, faces = close_mesh(vertices, faces)
    labels = counted = face_components(faces, len(vertices))
    if points is not None and labels.any():
        of_vertex = np.empty(len(vertices), labels.dtype)
        of_vertex[faces] = labels[:, None]
        used = used_vertices(faces, len(vertices))
        nearest = cKDTree(vertices[used]).query(points)[1]
        counted = of_vertex[used[nearest]]
    vertices, faces, _ = drop_unused_vertices(
        vertices, faces[labels == np.argmax(np.bincount(counted))]
    )
    return vertices, faces if signed_volume(vertices, faces) > 0 else faces[:, ::-1].copy()
