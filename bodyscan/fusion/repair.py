"""A nearly closed triangle mesh made a closed manifold one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from bodyscan.fusion.topology import corner_fans, directed_edges, is_among, without_unused

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


def closed(vertices: Array, faces: Indices) -> tuple[Array, Indices]:
    """Vertices (V, 3) and faces (F, 3) of a closed manifold surface made from nearly one.

    Faces at edges that more than two share go, surfaces that touch in a vertex are parted, holes
    are closed with fans of triangles. An octree's surface has a few such places; a closed
    manifold stays as it is, but for the numbers of its vertices.
    """
    faces = faces[~_unsound(faces, len(vertices))]
    labels, count = corner_fans(faces)
    parted = np.empty((count, 3))
    parted[labels] = vertices[faces.ravel()]
    return without_unused(*_holes_filled(parted, labels.reshape(-1, 3)))[:2]


def _unsound(faces: Indices, count: int) -> NDArray[np.bool_]:
    """(F,) faces with a repeated corner, or at an edge that two faces run along the same way."""
    edges = directed_edges(faces)
    keys = edges[:, 0] * count + edges[:, 1]
    order = np.argsort(keys, kind="stable")
    same = keys[order][1:] == keys[order][:-1]
    often = np.zeros(len(keys), bool)
    often[order[1:][same]] = often[order[:-1][same]] = True
    # The same edge's other side must go too, or it would be sewn to the wrong partner.
    undirected = edges.min(axis=1) * count + edges.max(axis=1)
    bad = is_among(undirected, undirected[often]) | (edges[:, 0] == edges[:, 1])
    return bad.reshape(3, -1).any(axis=0)


def _holes_filled(vertices: Array, faces: Indices) -> tuple[Array, Indices]:
    """Every rim gets a vertex at its middle and a triangle for each of its edges."""
    edges, count = directed_edges(faces), len(vertices)
    here = edges[:, 0] * count + edges[:, 1]
    there = edges[:, 1] * count + edges[:, 0]
    rim = edges[~is_among(here, there)]
    if not len(rim):
        return vertices, faces
    graph = coo_array((np.ones(len(rim), np.int8), (rim[:, 0], rim[:, 1])), shape=(count, count))
    piece = connected_components(graph, directed=False)[1][rim[:, 0]]
    hole = np.unique(piece, return_inverse=True)[1]
    size = np.bincount(hole)
    middles = np.stack(
        [np.bincount(hole, vertices[rim[:, 0], axis]) / size for axis in range(3)], axis=-1
    )
    fans = np.stack([rim[:, 1], rim[:, 0], count + hole], axis=-1)
    return np.concatenate([vertices, middles]), np.concatenate([faces, fans])
