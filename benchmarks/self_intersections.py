"""Where a triangle mesh passes through itself."""

from __future__ import annotations

import numpy as np
import open3d as o3d

from bodyscan.arrays import Array, Indices
from bodyscan.mesh.topology import list_directed_edges


def self_intersections(vertices: Array, faces: Indices) -> Indices:
    """Edges that pierce a face, (N, 3): their two vertices, and the face; vertices (V, 3).

    Two triangles intersect if and only if an edge of one pierces the other. Every edge is cast as a
    ray at all faces but those it touches; comparing triangles in pairs would be quadratic. In
    float32: exact to a ten-thousandth of a millimetre on a body.
    """
    edges = np.unique(np.sort(list_directed_edges(faces), axis=1), axis=0)
    # The scene computes in float32, so coordinates are centred first.
    places = (vertices - vertices.mean(axis=0)).astype(np.float32)
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.core.Tensor(places), o3d.core.Tensor(faces.astype(np.uint32)))
    start, end = places[edges[:, 0]], places[edges[:, 1]]
    rays = np.concatenate([start, end - start], axis=1)
    met = scene.list_intersections(o3d.core.Tensor(rays))
    share = met["t_hit"].numpy()
    within = (share >= 0.0) & (share <= 1.0)
    edge = edges[met["ray_ids"].numpy()[within].astype(np.int64)]
    face = met["primitive_ids"].numpy()[within].astype(np.int64)
    touches = (faces[face][:, :, None] == edge[:, None, :]).any(axis=(1, 2))
    return np.concatenate([edge, face[:, None]], axis=1)[~touches]
