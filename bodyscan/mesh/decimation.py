"""A smaller version of a body mesh: decimated, then refined where it strays from the full one."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np
import open3d as o3d
from scipy.spatial import cKDTree

from bodyscan.arrays import Array, Indices, Mask
from bodyscan.errors import ScanFailed
from bodyscan.mesh.body import BodyMesh
from bodyscan.mesh.half_edges import twins
from bodyscan.mesh.repair import largest_piece
from bodyscan.mesh.scene import centred_scene
from bodyscan.mesh.topology import topology, vertex_normals
from bodyscan.progress import THREADS

SPARE = 0.03  # share of the faces kept for where the decimated mesh strays
ROUNDS = 12  # of refinement


def decimate(mesh: BodyMesh, *, faces: int = 50_000, within_mm: float = 0.19) -> BodyMesh:
    """A closed mesh of about `faces` faces, no farther than `within_mm` from the full one.

    Quadric decimation (Garland and Heckbert 1997), which has no such limit, plus a few more faces
    where it went too far (some hundred at 50,000; many more where so few faces cannot do). Vertices
    take colour, sigma and region from the nearest one of the full mesh. A mesh that is small enough
    is returned as it is. The last result is cached by the mesh's content: a job exports it and then
    reports on it, each time read from the file.

    Raises ScanFailed if the surface does not stay closed.
    """
    if len(mesh.faces) <= faces:
        return mesh
    digest = hashlib.sha256()
    regions = () if mesh.regions is None else (mesh.regions,)
    for part in (mesh.vertices, mesh.faces, mesh.colours, mesh.sigma_mm, *regions):
        digest.update(np.ascontiguousarray(part).data)
    return _decimated(_Content(digest.digest(), mesh), faces, within_mm)


@dataclass(frozen=True)
class _Content:
    """A mesh compared with others by its digest."""

    digest: bytes
    mesh: BodyMesh = field(compare=False)


@lru_cache(1)
def _decimated(content: _Content, faces: int, within_mm: float) -> BodyMesh:
    mesh = content.mesh
    full = o3d.t.geometry.TriangleMesh(
        o3d.core.Tensor(mesh.vertices), o3d.core.Tensor(mesh.faces.astype(np.int32))
    )
    reduced = full.simplify_quadric_decimation(1.0 - (1.0 - SPARE) * faces / len(mesh.faces))
    vertices = reduced.vertex.positions.numpy().astype(np.float64)
    corners = reduced.triangle.indices.numpy().astype(np.int64)
    found = topology(vertices, corners)
    if not found.manifold or found.components > 1:
        # Where surfaces nearly touch (between fingers) a collapse may fold one onto the other.
        vertices, corners = largest_piece(vertices, corners)
        found = topology(vertices, corners)
    if not found.manifold:
        raise ScanFailed(
            f"the mesh did not stay closed when reduced to {faces} faces ({found})",
            remedy="Ask for more faces.",
        )
    vertices, corners = refine_to_tolerance(vertices, corners, mesh.vertices, mesh.faces, within_mm)
    nearest = np.asarray(cKDTree(mesh.vertices).query(vertices, workers=THREADS)[1])
    small = mesh.part(
        vertices, corners, nearest, np.any(np.isnan(mesh.sigma_mm)[nearest[corners]], axis=1)
    )
    return replace(small, normals=vertex_normals(vertices, corners))


class NearestSurface:
    """Nearest points on a triangle mesh; vertices (V, 3) mm, faces (F, 3)."""

    def __init__(self, vertices: Array, faces: Indices) -> None:
        self.scene, self.centre = centred_scene(vertices, faces)

    def nearest(self, points: Array) -> tuple[Array, Array, Indices]:
        """The nearest places (N, 3) to points (N, 3), their distances (N,) and faces (N,)."""
        if not len(points):
            return points, np.empty(0), np.empty(0, np.int64)
        centred = (points - self.centre).astype(np.float32)
        found = self.scene.compute_closest_points(o3d.core.Tensor(centred))
        places = found["points"].numpy()
        distance = np.linalg.norm(places.astype(np.float64) - centred, axis=-1)
        return places + self.centre, distance, found["primitive_ids"].numpy().astype(np.int64)


def refine_to_tolerance(
    vertices: Array, faces: Indices, full_vertices: Array, full_faces: Indices, limit_mm: float
) -> tuple[Array, Indices]:
    """Refine a closed mesh until it and the full one are within `limit_mm` of each other, if ROUNDS
    rounds suffice.

    The vertices of both are tested, and the middles of the mesh's edges and faces. Vertices too far
    off move to the nearest place of the full mesh. Faces too far off get a new vertex there: from
    the middle of the longest edge; or, where a vertex of the full mesh is too far from them, that
    one.
    """
    full = NearestSurface(full_vertices, full_faces)
    places, distance, _ = full.nearest(vertices)
    vertices = np.where((distance > limit_mm)[:, None], places, vertices)
    concerned, again = np.ones(len(faces), bool), np.arange(len(full_vertices))
    distance, face = np.empty(len(full_vertices)), np.empty(len(full_vertices), np.int64)
    for _ in range(ROUNDS):
        surface = NearestSurface(vertices, faces)
        _, distance[again], face[again] = surface.nearest(full_vertices[again])
        stray = _strays(vertices, faces, concerned, full, limit_mm)
        edges, across = _longest_edges(vertices, faces, stray)
        start, end = (faces.ravel()[edges], np.roll(faces, -1, axis=1).ravel()[edges])
        middles = full.nearest(0.5 * (vertices[start] + vertices[end]))[0]
        far, missed = _farthest(distance, face, len(faces), limit_mm)
        stray[edges // 3] = stray[across // 3] = True
        alone = ~stray[missed]
        far, missed = far[alone], missed[alone]
        stray[missed] = True
        if not stray.any():
            break
        # From here on only test what changed or is still too far.
        added = 2 * len(edges) + 2 * len(missed)
        concerned = np.concatenate([stray, np.ones(added, bool)])
        faces = _split_edges(faces, edges, across, len(vertices))
        faces = _split_faces(faces, missed, len(vertices) + len(edges))
        vertices = np.concatenate([vertices, middles, full_vertices[far]])
        again = np.flatnonzero(stray[face])
    return vertices, faces


def _strays(
    vertices: Array, faces: Indices, concerned: Mask, full: NearestSurface, limit_mm: float
) -> Mask:
    """Which of the `concerned` faces (F,) have their middle, or
    an edge's, too far from the full mesh."""
    corners = vertices[faces[concerned]]
    middles = [corners.mean(axis=1), *(0.5 * (corners[:, k] + corners[:, k - 1]) for k in range(3))]
    stray = concerned.copy()
    stray[concerned] = np.any([full.nearest(some)[1] > limit_mm for some in middles], axis=0)
    return stray


def _longest_edges(vertices: Array, faces: Indices, stray: Mask) -> tuple[Indices, Indices]:
    """Half-edges (N,) and their twins: the longest of stray faces, at most one edge per face."""
    corners = vertices[faces]
    length = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=-1)
    twin = twins(faces, len(vertices)).ravel()
    edges = 3 * np.flatnonzero(stray) + np.argmax(length[stray], axis=1)
    edges = np.unique(np.minimum(edges, twin[edges]))
    # An edge is split now if it ranks longest among the wanted edges of both its faces; others
    # wait.
    rank = np.empty(len(edges), np.int64)
    rank[np.argsort(length.ravel()[edges], kind="stable")] = np.arange(len(edges))
    highest = np.full(len(faces), -1)
    sides = edges // 3, twin[edges] // 3
    for side in sides:
        np.maximum.at(highest, side, rank)
    now = (highest[sides[0]] == rank) & (highest[sides[1]] == rank)
    return edges[now], twin[edges[now]]


def _split_edges(faces: Indices, edges: Indices, across: Indices, vertex_count: int) -> Indices:
    """Split half-edges (N,) and their twins at new vertices, numbered from `vertex_count` on;
    returns faces (F + 2 N, 3)."""
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
    """Of points too far from their nearest face: the farthest for each face (N,), and those faces
    (N,)."""
    far = np.flatnonzero(distance > limit_mm)
    far = far[np.argsort(distance[far], kind="stable")]
    last = np.full(face_count, -1)
    last[face[far]] = far
    missed = np.flatnonzero(last >= 0)
    return last[missed], missed


def _split_faces(faces: Indices, some: Indices, vertex_count: int) -> Indices:
    """Split N faces in three around new vertices, numbered from `vertex_count` on; returns faces (F
    + 2 N, 3)."""
    a, b, c = faces[some].T
    middle = vertex_count + np.arange(len(some))
    faces = faces.copy()
    faces[some, 2] = middle
    parts = np.concatenate([np.stack([b, c, middle], axis=-1), np.stack([c, a, middle], axis=-1)])
    return np.concatenate([faces, parts])
