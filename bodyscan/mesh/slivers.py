"""Removing faces without area, which trip up other programs."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from bodyscan.mesh.body import BodyMesh
from bodyscan.mesh.topology import directed_edges, drop_unused_vertices

PLACES = 4  # decimals of a millimetre: what text formats write, and far below any sigma


def without_slivers(mesh: BodyMesh) -> BodyMesh:
    """The mesh with every edge collapsed whose ends are one point when written, and its faces
    removed, so that a closed mesh stays closed."""
    places, edges = np.round(mesh.vertices, PLACES), directed_edges(mesh.faces)
    edges = edges[(places[edges[:, 0]] == places[edges[:, 1]]).all(axis=1)]
    if not len(edges):
        return mesh
    count = len(mesh.vertices)
    joined = coo_array((np.ones(len(edges), bool), edges.T), (count, count))
    _, group = connected_components(joined, directed=False)
    first = np.unique(group, return_index=True)[1]
    faces = first[group][mesh.faces]
    whole = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    vertices, faces, used = drop_unused_vertices(mesh.vertices, faces[whole])
    return mesh.part(vertices, faces, used, mesh.filled[whole])
