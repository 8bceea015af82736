"""A light mesh brought closer to the full one where it strays: a few more vertices there."""

from __future__ import annotations

import numpy as np
import open3d as o3d

from bodyscan.arrays import Array, Indices, Mask
from bodyscan.mesh.half_edges import twins

ROUNDS = 12


class Surface:
    """A triangle mesh that is asked for its nearest points; vertices (V, 3) mm, faces (F, 3)."""

    def __init__(self, vertices: Array, faces: Indices) -> None:
        # The scene computes in float32: coordinates are centred first.
        self.centre = vertices.mean(axis=0)
        self.scene = o3d.t.geometry.RaycastingScene()
        self.scene.add_triangles(
            o3d.core.Tensor((vertices - self.centre).astype(np.float32)),
            o3d.core.Tensor(faces.astype(np.uint32)),
        )

    def nearest(self, points: Array) -> tuple[Array, Array, Indices]:
        """Of points (N, 3): the nearest places (N, 3), how far they are (N,) and on which face."""
        if not len(points):
            return points, np.empty(0), np.empty(0, np.int64)
        centred = (points - self.centre).astype(np.float32)
        found = self.scene.compute_closest_points(o3d.core.Tensor(centred))
        places = found["points"].numpy()
        distance = np.linalg.norm(places.astype(np.float64) - centred, axis=-1)
        return places + self.centre, distance, found["primitive_ids"].numpy().astype(np.int64)


def brought_within(
    vertices: Array, faces: Indices, full_vertices: Array, full_faces: Indices, limit_mm: float
) -> tuple[Array, Indices]:
    """A closed mesh no farther than `limit_mm` from the full one, nor that from it, where ROUNDS
    rounds suffice.

    Looked at are the vertices of both, and the middles of the mesh's edges and faces. Vertices too
    far off go to the nearest place of the full mesh. Faces that are get a new vertex there: from the
    middle of the longest edge; or, where a vertex of the full mesh is too far from them, that one.
    """
    full = Surface(full_vertices, full_faces)
    places, distance, _ = full.nearest(vertices)
    vertices = np.where((distance > limit_mm)[:, None], places, vertices)
    concerned, asked = np.ones(len(faces), bool), full_vertices
    for _ in range(ROUNDS):
        _, distance, face = Surface(vertices, faces).nearest(asked)
        stray = _strays(vertices, faces, concerned, full, limit_mm)
        edges, across = _longest_edges(vertices, faces, stray)
        start, end = (faces.ravel()[edges], np.roll(faces, -1, axis=1).ravel()[edges])
        middles = full.nearest(0.5 * (vertices[start] + vertices[end]))[0]
        far, missed = _farthest(distance, face, len(faces), limit_mm)
        stray[across // 3] = True
        alone = ~stray[missed]
        far, missed = far[alone], missed[alone]
        stray[missed] = True
        if not stray.any():
            break
        # From now on only what changes, or still has to, is looked at.
        added = 2 * len(edges) + 2 * len(missed)
        concerned = np.concatenate([stray, np.ones(added, bool)])
        faces = _split(faces, edges, across, len(vertices))
        faces = _poked(faces, missed, len(vertices) + len(edges))
        vertices = np.concatenate([vertices, middles, asked[far]])
        asked = asked[stray[face]]
    return vertices, faces


def _strays(
    vertices: Array, faces: Indices, concerned: Mask, full: Surface, limit_mm: float
) -> Mask:
    """(F,) those of some faces whose middle, or an edge's, lies too far from the full mesh."""
    corners = vertices[faces[concerned]]
    middles = [corners.mean(axis=1), *(0.5 * (corners[:, k] + corners[:, k - 1]) for k in range(3))]
    stray = concerned.copy()
    stray[concerned] = np.any([full.nearest(some)[1] > limit_mm for some in middles], axis=0)
    return stray


def _longest_edges(vertices: Array, faces: Indices, stray: Mask) -> tuple[Indices, Indices]:
    """Half-edges (N,) and their twins: the longest of stray faces, at most one edge to a face."""
    corners = vertices[faces]
    length = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=-1)
    twin = twins(faces, len(vertices)).ravel()
    edges = 3 * np.flatnonzero(stray) + np.argmax(length[stray], axis=1)
    edges = np.unique(np.minimum(edges, twin[edges]))
    # An edge is split now if it is the longest of all that want one of its two faces, or waits.
    rank = np.empty(len(edges), np.int64)
    rank[np.argsort(length.ravel()[edges], kind="stable")] = np.arange(len(edges))
    highest = np.full(len(faces), -1)
    sides = edges // 3, twin[edges] // 3
    for side in sides:
        np.maximum.at(highest, side, rank)
    now = (highest[sides[0]] == rank) & (highest[sides[1]] == rank)
    return edges[now], twin[edges[now]]


def _split(faces: Indices, edges: Indices, across: Indices, vertex_count: int) -> Indices:
    """Faces (F + 2 N, 3) with half-edges (N,) and their twins split at new vertices, numbered from
    `vertex_count` on."""
    both = np.concatenate([edges, across])
    middle = vertex_count + np.tile(np.arange(len(edges)), 2)
    face, corner = both // 3, both % 3
    start, end, opposite = (faces[face, (corner + k) % 3] for k in range(3))
    faces = faces.copy()
    faces[face] = np.stack([start, middle, opposite], axis=-1)
    return np.concatenate([faces, np.stack([middle, end, opposite], axis=-1)])


def _farthest(
    distance: Array, face: Indices, face_count: int, limit_mm: float
) -> tuple[Indices, Indices]:
    """Of points too far from the face that is their nearest: the farthest of each face (N,), and
    those faces (N,)."""
    far = np.flatnonzero(distance > limit_mm)
    far = far[np.argsort(distance[far], kind="stable")]
    last = np.full(face_count, -1)
    last[face[far]] = far
    missed = np.flatnonzero(last >= 0)
    return last[missed], missed


def _poked(faces: Indices, some: Indices, vertex_count: int) -> Indices:
    """Faces (F + 2 N, 3) with N of them made three each, around a new vertex; these are numbered from
    `vertex_count` on."""
    a, b, c = faces[some].T
    middle = vertex_count + np.arange(len(some))
    faces = faces.copy()
    faces[some, 2] = middle
    parts = np.concatenate([np.stack([b, c, middle], axis=-1), np.stack([c, a, middle], axis=-1)])
    return np.concatenate([faces, parts])
