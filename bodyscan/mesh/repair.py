"""Repair and reduce triangle meshes: closed manifolds, without faces of no area, of fewer faces."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from fast_simplification import simplify
from scipy.spatial import cKDTree

from bodyscan.arrays import Array, Indices
from bodyscan.errors import ScanFailed
from bodyscan.mesh.body import BodyMesh
from bodyscan.mesh.topology import (
    RIM,
    UNSOUND,
    compute_signed_volume,
    compute_topology,
    compute_vertex_normals,
    connect,
    drop_unused_vertices,
    find_twins,
    find_used_vertices,
    label_components,
    label_corner_fans,
    list_directed_edges,
)
from bodyscan.progress import THREADS


def close_mesh(vertices: Array, faces: Indices) -> tuple[Array, Indices]:
    """Make a nearly closed surface of vertices (V, 3) and faces (F, 3) a closed manifold.

    Faces at edges shared by more than two are removed, surfaces that touch in a vertex are
    separated, holes are closed with fans of triangles. An octree's surface has a few such places; a
    closed manifold is unchanged, except for the numbers of its vertices.
    """
    twin = find_twins(faces, len(vertices))
    sound = (twin != UNSOUND).all(axis=1)
    if not sound.all():
        faces = faces[sound]
        twin = find_twins(faces, len(vertices))
    corners, count = label_corner_fans(twin)
    positions = np.empty((count, 3))
    positions[corners] = vertices[faces]
    ends = np.roll(corners, -1, axis=1)
    rim = np.stack([corners[twin == RIM], ends[twin == RIM]], axis=-1)
    return _fill_holes(positions, corners, rim)


def _fill_holes(vertices: Array, faces: Indices, rim: Indices) -> tuple[Array, Indices]:
    """Close every rim, given by edges (N, 2), by a fan of triangles about its mean."""
    if not len(rim):
        return vertices, faces
    corners, ends = np.unique(rim, return_inverse=True)
    ends = ends.reshape(-1, 2)
    hole = connect(ends, len(corners))[1][ends[:, 0]]
    size = np.bincount(hole)
    means = np.stack([np.bincount(hole, x) / size for x in vertices[rim[:, 0]].T], axis=-1)
    fans = np.stack([rim[:, 1], rim[:, 0], len(vertices) + hole], axis=-1)
    return np.concatenate([vertices, means]), np.concatenate([faces, fans])


def extract_largest_piece(
    vertices: Array, faces: Indices, points: Array | None = None
) -> tuple[Array, Indices]:
    """Extract the connected component with the most faces, closed and outward.

    points: (N, 3); choose the component nearest to most of these instead: what closes the surface
        behind a wall may have more faces than what was scanned before it.
    """
    vertices, faces = close_mesh(vertices, faces)
    labels = votes = label_components(faces, len(vertices))
    if points is not None and labels.any():
        of_vertex = np.empty(len(vertices), labels.dtype)
        of_vertex[faces] = labels[:, None]
        used = find_used_vertices(faces, len(vertices))
        votes = of_vertex[used[cKDTree(vertices[used]).query(points)[1]]]
    largest = faces[labels == np.argmax(np.bincount(votes))]
    vertices, faces, _ = drop_unused_vertices(vertices, largest)
    return vertices, faces if compute_signed_volume(vertices, faces) > 0 else faces[:, ::-1].copy()


def collapse_slivers(mesh: BodyMesh) -> BodyMesh:
    """Collapse every edge whose ends are one point in a text file; a closed mesh stays closed.

    Faces without area trip up other programs. Four decimals of a mm are written: far below sigmas.
    """
    written, edges = np.round(mesh.vertices, 4), list_directed_edges(mesh.faces)
    edges = edges[(written[edges[:, 0]] == written[edges[:, 1]]).all(axis=1)]
    if not len(edges):
        return mesh
    group = connect(edges, len(mesh.vertices))[1]
    first = np.unique(group, return_index=True)[1]
    faces = first[group][mesh.faces]
    whole = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    vertices, faces, used = drop_unused_vertices(mesh.vertices, faces[whole])
    return mesh.part(vertices, faces, used, mesh.filled[whole])


def decimate(mesh: BodyMesh, *, faces: int = 50_000) -> BodyMesh:
    """Reduce to a closed mesh of about `faces` faces (Garland and Heckbert 1997).

    Vertices take colour, sigma and region from the nearest vertex of the full mesh; a face with a
    corner that nothing measured is filled. A body of 50,000 faces lies within 0.3 mm of the full
    one at 99.9 % of its surface, within 0.5 mm everywhere. A mesh that is small enough is returned
    as it is. Raises ScanFailed if the surface does not stay closed.
    """
    if len(mesh.faces) <= faces:
        return mesh
    vertices, corners = simplify(mesh.vertices, mesh.faces.astype(np.int32), target_count=faces)
    corners = corners.astype(np.int64)
    shape = compute_topology(vertices, corners)
    if not shape.manifold or shape.components > 1:
        # Where surfaces nearly touch (between fingers) a collapse may fold one onto the other.
        vertices, corners = extract_largest_piece(vertices, corners)
        shape = compute_topology(vertices, corners)
    if not shape.manifold:
        what = f"the mesh did not stay closed when reduced to {faces} faces ({shape})"
        raise ScanFailed(what, remedy="Ask for more faces.")
    nearest = np.asarray(cKDTree(mesh.vertices).query(vertices, workers=THREADS)[1])
    filled = np.any(np.isnan(mesh.sigma_mm)[nearest[corners]], axis=1)
    small = mesh.part(vertices, corners, nearest, filled)
    return replace(small, normals=compute_vertex_normals(vertices, corners))
