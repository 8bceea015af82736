"""Rings that a body forms where its parts touch: a hand on the hip, one knee against the other.

The mesh is cut into layers. The pieces of all layers, joined where they meet, make a graph; on a
surface without handles that graph is a tree whatever the shape (it is the nerve of the height's
level sets, see Reeb 1946), and each ring of it is a handle of the surface.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from bodyscan.arrays import Array, Indices
from bodyscan.mesh.topology import directed_edges

LAYER_MM = 20.0


@dataclass(frozen=True)
class Ring:
    """A closed ring of body parts: its lowest and highest
    point, the y of its middle; rig frame, mm."""

    low_mm: float
    high_mm: float
    y_mm: float


def rings(vertices: Array, faces: Indices, *, smallest_mm: float = 80.0) -> list[Ring]:
    """Rings at least `smallest_mm` high in a closed mesh, from the lowest up."""
    edges = directed_edges(faces)
    edges = edges[edges[:, 0] < edges[:, 1]]
    # An edge that skipped a layer would create a ring where there is none.
    layer_mm = max(LAYER_MM, float(np.abs(np.diff(vertices[edges, 2], axis=1)).max()))
    layer = np.floor(vertices[:, 2] / layer_mm).astype(np.int64)
    within = layer[edges[:, 0]] == layer[edges[:, 1]]
    size = len(vertices)
    graph = coo_array(
        (np.ones(np.count_nonzero(within), np.int8), tuple(edges[within].T)), shape=(size, size)
    )
    count, piece = connected_components(graph, directed=False)
    height = np.zeros(count)
    height[piece] = layer_mm * (layer + 0.5)
    y = np.bincount(piece, vertices[:, 1], count) / np.bincount(piece, minlength=count)
    joined = without_branches(np.unique(piece[edges[~within]], axis=0))
    if not len(joined):
        return []
    import networkx as nx  # takes a fifth of a second to load; few bodies have a ring

    found = []
    for cycle in nx.minimum_cycle_basis(nx.Graph(joined.tolist())):
        heights = height[cycle]
        if np.ptp(heights) >= smallest_mm:
            found.append(Ring(float(heights.min()), float(heights.max()), float(y[cycle].mean())))
    return sorted(found, key=lambda ring: (ring.low_mm, ring.y_mm))


def without_branches(joined: Indices) -> Indices:
    """The links (N, 2) that are in a ring or between two."""
    joined = np.unique(np.sort(joined, axis=1), axis=0)
    while True:
        inside = (np.bincount(joined.ravel())[joined] > 1).all(axis=1)
        if inside.all():
            return joined
        joined = joined[inside]
