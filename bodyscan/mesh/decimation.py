"""Reduce a body mesh to fewer faces: decimated, then refined where it deviates from the full mesh."""

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
from bodyscan.mesh.nearest_surface import NearestSurface
from bodyscan.mesh.repair import extract_largest_piece
from bodyscan.mesh.topology import compute_topology, find_twins, vertex_normals
from bodyscan.progress import THREADS


def decimate(mesh: BodyMesh, *, faces: int = 50_000, within_mm: float = 0.19) -> BodyMesh:
    """Reduce to a closed mesh of about `faces` faces, at most `within_mm` from the full one.

    Quadric decimation (Garland and Heckbert 1997), which has no such limit, then refinement where
    it deviates too far (some hundred faces at 50,000). Vertices take colour, sigma and region from
    the nearest vertex of the full mesh. A mesh that is small enough is returned as it is. The last
    result is cached by content: a job exports it and then reports on it, each time read anew.

    Raises ScanFailed if the surface does not stay closed.
    """
    if len(mesh.faces) <= faces:
        return mesh
    digest = hashlib.sha256()
    regions = () if mesh.regions is None else (mesh.regions,)
    for part in (mesh.vertices, mesh.faces, mesh.colours, mesh.sigma_mm, *regions):
        digest.update(np.ascontiguousarray(part).data)
    return _decimate(_Content(digest.digest(), mesh), faces, within_mm)


@dataclass(frozen=True)
class _Content:
    """A mesh compared with others by its digest."""

    digest: bytes
    mesh: BodyMesh = field(compare=False)


@lru_cache(1)
def _decimate(content: _Content, faces: int, within_mm: float) -> BodyMesh:
    mesh = content.mesh
    full = o3d.t.geometry.TriangleMesh(
        o3d.core.Tensor(mesh.vertices), o3d.core.Tensor(mesh.faces.astype(np.int32))
    )
    # 3 % of the faces are kept for the refinement.
    reduced = full.simplify_quadric_decimation(1.0 - 0.97 * faces / len(mesh.faces))
    vertices = reduced.vertex.positions.numpy().astype(np.float64)
    corners = reduced.triangle.indices.numpy().astype(np.int64)
    shape = compute_topology(vertices, corners)
    if not shape.manifold or shape.components > 1:
        # Where surfaces nearly touch (between fingers) a collapse may fold one onto the other.
        vertices, corners = extract_largest_piece(vertices, corners)
        shape = compute_topology(vertices, corners)
    if not shape.manifold:
        raise ScanFailed(
            f"the mesh did not stay closed when reduced to {faces} faces ({shape})",
            remedy="Ask for more faces.",
        )
    vertices, corners = refine_to_tolerance(vertices, corners, mesh.vertices, mesh.faces, within_mm)
    nearest = np.asarray(cKDTree(mesh.vertices).query(vertices, workers=THREADS)[1])
    filled = np.any(np.isnan(mesh.sigma_mm)[nearest[corners]], axis=1)
    small = mesh.part(vertices, corners, nearest, filled)
    return replace(small, normals=vertex_normals(vertices, corners))


def refine_to_tolerance(
    vertices: Array, faces: Indices, full_vertices: Array, full_faces: Indices, limit_mm: float
) -> tuple[Array, Indices]:
    """Refine a closed mesh until it and the full one are within `limit_mm` of each other.

    Tested are the vertices of both, and the midpoints of the mesh's edges and faces. Vertices too
    far off move to the nearest point of the full mesh. Faces too far off get a new vertex there:
    from the midpoint of the longest edge, or the farthest vertex of the full mesh that is nearest
    to them. Ends after twelve rounds even if some are still too far.
    """
    full = NearestSurface(full_vertices, full_faces)
    nearest, distance, _ = full.nearest(vertices)
    vertices = np.where((distance > limit_mm)[:, None], nearest, vertices)
    active, again = np.ones(len(faces), bool), np.arange(len(full_vertices))
    distance, face = np.empty(len(full_vertices)), np.empty(len(full_vertices), np.int64)
    for _ in range(12):
        surface = NearestSurface(vertices, faces)
        _, distance[again], face[again] = surface.nearest(full_vertices[again])
        stray = _find_strays(vertices, faces, active, full, limit_mm)
        edges, across = _select_edges(vertices, faces, stray)
        start, end = faces.ravel()[edges], np.roll(faces, -1, axis=1).ravel()[edges]
        midpoints = full.nearest(0.5 * (vertices[start] + vertices[end]))[0]
        far, missed = _find_farthest(distance, face, len(faces), limit_mm)
        stray[edges // 3] = stray[across // 3] = True
        unsplit = ~stray[missed]
        far, missed = far[unsplit], missed[unsplit]
        stray[missed] = True
        if not stray.any():
            break
        # From here on only test what changed or is still too far.
        added = 2 * len(edges) + 2 * len(missed)
        active = np.concatenate([stray, np.ones(added, bool)])
        faces = _split_edges(faces, edges, across, len(vertices))
        faces = _split_faces(faces, missed, len(vertices) + len(edges))
        vertices = np.concatenate([vertices, midpoints, full_vertices[far]])
        again = np.flatnonzero(stray[face])
    return vertices, faces


def _find_strays(
    vertices: Array, faces: Indices, active: Mask, full: NearestSurface, limit_mm: float
) -> Mask:
    """Find `active` faces (F,) whose centre or edges' midpoints are too far from the full mesh."""
    corners = vertices[faces[active]]
    tested = [corners.mean(axis=1), *(0.5 * (corners[:, k] + corners[:, k - 1]) for k in range(3))]
    stray = active.copy()
    stray[active] = np.any([full.nearest(points)[1] > limit_mm for points in tested], axis=0)
    return stray


def _select_edges(vertices: Array, faces: Indices, stray: Mask) -> tuple[Indices, Indices]:
    """Select half-edges (N,) to split, and their twins: the longest of stray faces, one a face."""
    corners = vertices[faces]
    length = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=-1)
    twin = find_twins(faces, len(vertices)).ravel()
    edges = 3 * np.flatnonzero(stray) + np.argmax(length[stray], axis=1)
    edges = np.unique(np.minimum(edges, twin[edges]))
    # An edge is split in this round if it is the longest wanted edge of both its faces.
    rank = np.empty(len(edges), np.int64)
    rank[np.argsort(length.ravel()[edges], kind="stable")] = np.arange(len(edges))
    highest = np.full(len(faces), -1)
    sides = edges // 3, twin[edges] // 3
    for side in sides:
        np.maximum.at(highest, side, rank)
    now = (highest[sides[0]] == rank) & (highest[sides[1]] == rank)
    return edges[now], twin[edges[now]]


def _split_edges(faces: Indices, edges: Indices, across: Indices, vertex_count: int) -> Indices:
    """Split half-edges (N,) and their twins at new vertices, numbered from `vertex_count` on, to
    faces (F + 2 N, 3)."""
    both = np.concatenate([edges, across])
    middle = vertex_count + np.tile(np.arange(len(edges)), 2)
    face, corner = both // 3, both % 3
    start, end, opposite = (faces[face, (corner + k) % 3] for k in range(3))
    faces = faces.copy()
    faces[face] = np.stack([start, middle, opposite], axis=-1)
    return np.concatenate([faces, np.stack([middle, end, opposite], axis=-1)])


def _find_farthest(
    distance: Array, face: Indices, face_count: int, limit_mm: float
) -> tuple[Indices, Indices]:
    """Find, of points too far from their nearest face, the farthest (N,) of each face (N,)."""
    far = np.flatnonzero(distance > limit_mm)
    far = far[np.argsort(distance[far], kind="stable")]
    last = np.full(face_count, -1)
    last[face[far]] = far
    missed = np.flatnonzero(last >= 0)
    return last[missed], missed


def _split_faces(faces: Indices, split: Indices, vertex_count: int) -> Indices:
    """Split N faces in three around new vertices, numbered from `vertex_count` on, to faces
    (F + 2 N, 3)."""
    a, b, c = faces[split].T
    middle = vertex_count + np.arange(len(split))
    faces = faces.copy()
    faces[split, 2] = middle
    parts = np.concatenate([np.stack([b, c, middle], axis=-1), np.stack([c, a, middle], axis=-1)])
    return np.concatenate([faces, parts])
