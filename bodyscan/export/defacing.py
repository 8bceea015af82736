"""A body without a recognisable face: the head above the neck is replaced, not smoothed.

Smoothing keeps the triangles of the head, and their density still hints at the face. So everything
above the neck is removed, and a plain ellipsoid of usual proportions, for which only the height of
the head is known, is put on the neck.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from bodyscan.arrays import Array, Indices, Mask
from bodyscan.errors import FailedWork
from bodyscan.export.neck import REACH_MM, Neck
from bodyscan.mesh.body import BodyMesh
from bodyscan.mesh.regions import regions_at
from bodyscan.mesh.topology import (
    directed_edges,
    drop_unused_vertices,
    face_components,
    vertex_normals,
)

GREY = 150
RINGS = 40
# Shares of the height from neck to crown: half the head's length and breadth, where it is widest,
# and where the neck's own shape ends.
HALF_LENGTH, HALF_BREADTH, WIDEST, NECK_ENDS = 0.36, 0.28, 0.52, 0.45
HARMONICS = 4  # of the neck's outline, from which the head continues
ROUNDED_MM = 10.0  # the head's height is kept no more exactly than this
_MENDINGS = 50


def deface(mesh: BodyMesh, neck: Neck) -> BodyMesh:
    """`mesh` with a plain grey head, whose vertices have no sigma and whose faces are `filled`.

    Vertices and faces below the neck keep their order and every bit. A closed mesh stays closed; an
    open one (only what was measured) ends at the neck. Raises FailedWork if there is nothing above
    the neck, or its rim is not a simple line.
    """
    head = _head_faces(mesh, neck)
    closed = not len(_free_edges(mesh.faces))
    if closed:
        head = _with_simple_rim(mesh.faces, head)
    crown_mm = float(mesh.vertices[mesh.faces[head]][..., 2].max())
    crown_mm = neck.height_mm + ROUNDED_MM * round((crown_mm - neck.height_mm) / ROUNDED_MM)
    vertices, faces, used = drop_unused_vertices(mesh.vertices, mesh.faces[~head])
    number_of = np.full(len(mesh.vertices), -1, np.int64)
    number_of[used] = np.arange(len(used))
    # Free edges of the head run opposite to those of what was kept.
    rims = _loops(number_of[_free_edges(mesh.faces[head])[:, ::-1]]) if closed else []
    all_vertices, all_faces = [vertices], [faces]
    for number, rim in enumerate(sorted(rims, key=len, reverse=True)):
        start = sum(map(len, all_vertices))
        cap = vertices[rim].mean(axis=0)[None] if number else _dome(vertices[rim], crown_mm)
        all_vertices.append(cap)
        all_faces.append(_stitched(rim, start, len(cap)))
    return _attach_attributes(
        mesh, head, used, np.concatenate(all_vertices), np.concatenate(all_faces)
    )


def _attach_attributes(
    mesh: BodyMesh, head: Mask, used: Indices, vertices: Array, faces: Indices
) -> BodyMesh:
    """The mesh with what was kept unchanged, and what was added grey, filled and without sigma."""
    added = len(vertices) - len(used)
    filled = mesh.filled[~head]
    return BodyMesh(
        vertices,
        faces,
        np.concatenate([mesh.normals[used], vertex_normals(vertices, faces)[len(used) :]]),
        np.concatenate([mesh.colours[used], np.full((added, 3), GREY, np.uint8)]),
        np.concatenate([mesh.sigma_mm[used], np.full(added, np.nan, np.float32)]),
        np.concatenate([filled, np.ones(len(faces) - len(filled), bool)]),
        regions=regions_at(mesh.regions, np.concatenate([used, np.full(added, -1)])),
    )


def _head_faces(mesh: BodyMesh, neck: Neck) -> Mask:
    """Faces (F,) that reach above the neck, in pieces that come near the head's axis.

    Hands held up beside the head are other pieces, and stay.
    """
    reaching = (mesh.vertices[mesh.faces][..., 2] > neck.height_mm).any(axis=1)
    faces = mesh.faces[reaching]
    if not len(faces):
        raise FailedWork(f"nothing of the mesh stands above the neck, {neck.height_mm:.0f} mm")
    pieces = face_components(faces, len(mesh.vertices))
    away = np.linalg.norm(mesh.vertices[faces][..., :2] - neck.axis, axis=-1).min(axis=1)
    nearest = np.full(pieces.max() + 1, np.inf)
    np.minimum.at(nearest, pieces, away)
    head = np.zeros(len(mesh.faces), bool)
    head[reaching] = nearest[pieces] < REACH_MM / 2.0
    return head


def _with_simple_rim(faces: Indices, head: Mask) -> Mask:
    """Remove faces from the head where its rim touches itself, until the rim is a simple line."""
    for _ in range(_MENDINGS):
        points, times = np.unique(_free_edges(faces[head])[:, 0], return_counts=True)
        if not (times > 1).any():
            return head
        head = head & ~np.isin(faces, points[times > 1]).any(axis=1)
    raise FailedWork("the mesh cannot be cut at the neck", remedy="look at the mesh there")


def _free_edges(faces: Indices) -> Indices:
    """Directed edges (E, 2) that no face runs along in the opposite direction."""
    edges = directed_edges(faces)
    count = int(faces.max(initial=-1)) + 1
    twins = np.isin(edges[:, 0] * count + edges[:, 1], edges[:, 1] * count + edges[:, 0])
    return edges[~twins]


def _loops(edges: Indices) -> list[Indices]:
    """Closed lines of vertices; each point has exactly one successor."""
    following = dict(edges.tolist())
    loops = []
    while following:
        start, after = following.popitem()
        loop = [start]
        while after != start:
            loop.append(after)
            after = following.pop(after)
        loops.append(np.array(loop, np.int64))
    return loops


def _dome(rim: Array, crown_mm: float) -> Array:
    """Rings over a rim (N, 3), from its shape to an
    ellipsoid's, and the top: (RINGS * N + 1, 3)."""
    line = _smooth(rim)  # the rim itself zigzags from face to face
    centre = line[:, :2].mean(axis=0)
    arm, ahead = line[:, :2] - centre, np.roll(line, -1, axis=0)[:, :2] - line[:, :2]
    turns = np.sign((arm[:, 0] * ahead[:, 1] - arm[:, 1] * ahead[:, 0]).sum())
    angle = np.arctan2(arm[0, 1], arm[0, 0]) + turns * 2.0 * np.pi * np.arange(len(rim)) / len(rim)
    height = crown_mm - float(rim[:, 2].mean())
    ellipse = height * np.stack([HALF_LENGTH * np.cos(angle), HALF_BREADTH * np.sin(angle)], axis=1)
    half = RINGS // 2
    rising = np.sin(np.linspace(0.0, np.pi / 2.0, RINGS - half + 1))[:-1]
    part = np.concatenate(
        [WIDEST * np.arange(1, half + 1) / (half + 1), WIDEST + (1 - WIDEST) * rising]
    )
    up = np.clip(part / NECK_ENDS, 0.0, 1.0)
    blend = (up * up * (3.0 - 2.0 * up))[:, None, None]
    narrowing = np.sqrt(1.0 - (np.maximum(part - WIDEST, 0.0) / (1.0 - WIDEST)) ** 2)
    flat = (1.0 - blend) * arm + blend * narrowing[:, None, None] * ellipse
    z = (1.0 - part[:, None]) * line[:, 2] + part[:, None] * crown_mm
    rings = np.concatenate([centre + flat, z[..., None]], axis=-1)
    return np.concatenate([rings.reshape(-1, 3), [[*centre, crown_mm]]])


def _smooth(line: Array) -> Array:
    """A closed line (N, 3) reduced to its first few harmonics."""
    waves = np.fft.rfft(line, axis=0)
    waves[HARMONICS + 1 :] = 0.0
    return np.fft.irfft(waves, len(line), axis=0)


def _stitched(rim: Indices, start: int, count: int) -> Indices:
    """Faces over a rim (in the kept faces' direction): rings
    of vertices from `start`, then a top."""
    size = len(rim)
    rings = [rim, *(start + np.arange(count - 1)).reshape(-1, size)]
    faces = []
    for lower, upper in pairwise(rings):
        low_next, up_next = np.roll(lower, -1), np.roll(upper, -1)
        faces += [np.stack([low_next, lower, upper], 1), np.stack([low_next, upper, up_next], 1)]
    top = np.full(size, start + count - 1)
    return np.concatenate([*faces, np.stack([np.roll(rings[-1], -1), rings[-1], top], axis=1)])
