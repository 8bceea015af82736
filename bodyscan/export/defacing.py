"""Make a face unrecognisable: the head above the neck is replaced, not smoothed.

Smoothing keeps the triangles of the head, and their density still hints at the face. So everything
above the neck is removed, and a plain ellipsoid of average proportions, for which only the height
of the head is known, is put on the neck.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from bodyscan.arrays import Array, Indices, Mask
from bodyscan.errors import FailedWork
from bodyscan.mesh.body import BodyMesh, select_regions
from bodyscan.mesh.slices import MeshSlicer, compute_hull_perimeter
from bodyscan.mesh.topology import (
    RIM,
    compute_vertex_normals,
    drop_unused_vertices,
    find_twins,
    label_components,
)

REACH_MM = 160.0  # from the head's axis; arms and shoulders farther out do not count


@dataclass(frozen=True, eq=False)
class Neck:
    """height_mm: of the neck above the floor (z). axis: (2,) x and y of the head. Rig frame, mm."""

    height_mm: float
    axis: Array


def find_neck(vertices: Array, faces: Indices) -> Neck:
    """Find the narrowest slice below the head of a standing body, vertices (V, 3), faces (F, 3).

    A slice's size is the perimeter of its convex hull, within REACH_MM of the head's axis; the head
    is what is highest above the body's middle, so that a raised hand is not mistaken for it. Raises
    FailedWork if there is no such slice.
    """
    remedy = "look at the mesh: does the subject stand upright, arms not overhead?"
    not_found = FailedWork("no neck was found, so the face cannot be removed", remedy=remedy)
    if len(vertices) < 1000:  # a head alone has more, even of the light version
        raise not_found
    axis, top = _find_crown(vertices)
    stature = top - float(vertices[:, 2].min())
    # From crown to neck: 9 % of a tall adult's stature, 24 % of a small child's.
    heights = np.arange(top - 0.24 * stature, top - 0.09 * stature, 4.0)
    to_shoulders = 0.07 * stature
    near = np.linalg.norm(vertices[:, :2] - axis, axis=1) < 2.0 * REACH_MM
    near &= vertices[:, 2] > heights[0] - (to_shoulders + REACH_MM)
    slicer = MeshSlicer(vertices, faces[near[faces].all(axis=1)])
    girths = np.array([_measure_girth(slicer, height, axis) for height in heights])
    narrowest = int(np.argmin(girths)) if girths.size else 0
    neck = float(girths[narrowest])
    head = max(girths[narrowest:].max(), _measure_girth(slicer, top - 0.06 * stature, axis))
    shoulders = _measure_girth(slicer, heights[narrowest] - to_shoulders, axis)
    inside = 0 < narrowest < len(girths) - 1 and 180.0 < neck < 700.0
    # Wrists of arms held overhead are narrow too, but have no head above and no shoulders below.
    if not (inside and head > 400.0 and head > 1.1 * neck and shoulders > 1.5 * neck):
        raise not_found
    return Neck(float(heights[narrowest]), axis)


def _measure_girth(slicer: MeshSlicer, height: float, axis: Array) -> float:
    """Compute a slice's hull perimeter, mm, near `axis` (x, y); infinite for too few points."""
    loops = slicer.slice(height)
    points = np.concatenate([np.empty((0, 2)), *(loop.segments[:, 0] for loop in loops)])
    points = points[np.linalg.norm(points - axis, axis=1) < REACH_MM]
    return compute_hull_perimeter(points) if len(points) > 3 else float("inf")


def _find_crown(vertices: Array) -> tuple[Array, float]:
    """Find the head's axis (x, y) and height: the top of what is above the trunk's middle."""
    low, high = vertices[:, 2].min(), vertices[:, 2].max()
    trunk = vertices[np.abs(vertices[:, 2] - (low + 0.55 * (high - low))) < 0.1 * (high - low)]
    middle = np.median(trunk[:, :2], axis=0)
    over = vertices[np.linalg.norm(vertices[:, :2] - middle, axis=1) < REACH_MM]
    top = float(over[:, 2].max())
    head = over[over[:, 2] > top - 100.0]
    return np.median(head[:, :2], axis=0), top


def deface(mesh: BodyMesh, neck: Neck) -> BodyMesh:
    """Replace the head by a plain grey one, whose vertices have no sigma and whose faces are filled.

    Vertices and faces below the neck keep their order and every bit. A closed mesh stays closed; an
    open one (only what was measured) ends at the neck. Raises FailedWork if there is nothing above
    the neck, or its rim is not a simple line.
    """
    head = _find_head_faces(mesh, neck)
    closed = not len(_find_free_edges(mesh.faces))
    if closed:
        head = _simplify_rim(mesh.faces, head)
    crown_mm = float(mesh.vertices[mesh.faces[head]][..., 2].max())
    # The head's height is kept to a centimetre only.
    crown_mm = neck.height_mm + 10.0 * round((crown_mm - neck.height_mm) / 10.0)
    vertices, faces, used = drop_unused_vertices(mesh.vertices, mesh.faces[~head])
    index = np.full(len(mesh.vertices), -1, np.int64)
    index[used] = np.arange(len(used))
    # Free edges of the head run opposite to those of what was kept.
    rims = _trace_loops(index[_find_free_edges(mesh.faces[head])[:, ::-1]]) if closed else []
    for number, rim in enumerate(sorted(rims, key=len, reverse=True)):
        cap = vertices[rim].mean(axis=0)[None] if number else _build_dome(vertices[rim], crown_mm)
        faces = np.concatenate([faces, _stitch(rim, len(vertices), len(cap))])
        vertices = np.concatenate([vertices, cap])
    added = len(vertices) - len(used)
    filled = mesh.filled[~head]
    return BodyMesh(
        vertices,
        faces,
        np.concatenate([mesh.normals[used], compute_vertex_normals(vertices, faces)[len(used) :]]),
        np.concatenate([mesh.colours[used], np.full((added, 3), 150, np.uint8)]),
        np.concatenate([mesh.sigma_mm[used], np.full(added, np.nan, np.float32)]),
        np.concatenate([filled, np.ones(len(faces) - len(filled), bool)]),
        regions=select_regions(mesh.regions, np.concatenate([used, np.full(added, -1)])),
    )


def _find_head_faces(mesh: BodyMesh, neck: Neck) -> Mask:
    """Find faces (F,) that reach above the neck, in components that come near the head's axis. Hands
    held up beside the head are other components, and stay."""
    reaching = (mesh.vertices[mesh.faces][..., 2] > neck.height_mm).any(axis=1)
    faces = mesh.faces[reaching]
    if not len(faces):
        raise FailedWork(f"the mesh has nothing above the neck at {neck.height_mm:.0f} mm")
    labels = label_components(faces, len(mesh.vertices))
    away = np.linalg.norm(mesh.vertices[faces][..., :2] - neck.axis, axis=-1).min(axis=1)
    nearest = np.full(labels.max() + 1, np.inf)
    np.minimum.at(nearest, labels, away)
    head = np.zeros(len(mesh.faces), bool)
    head[reaching] = nearest[labels] < REACH_MM / 2.0
    return head


def _simplify_rim(faces: Indices, head: Mask) -> Mask:
    """Take faces out of the head where its rim touches itself, until it is a simple line."""
    for _ in range(50):
        points, times = np.unique(_find_free_edges(faces[head])[:, 0], return_counts=True)
        if not (times > 1).any():
            return head
        head = head & ~np.isin(faces, points[times > 1]).any(axis=1)
    raise FailedWork("the mesh cannot be cut at the neck", remedy="look at the mesh there")


def _find_free_edges(faces: Indices) -> Indices:
    """Find directed edges (E, 2) without a twin."""
    face, corner = np.nonzero(find_twins(faces, int(faces.max(initial=-1)) + 1) == RIM)
    return np.stack([faces[face, corner], faces[face, (corner + 1) % 3]], axis=-1)


def _trace_loops(edges: Indices) -> list[Indices]:
    """Trace directed edges (E, 2), one from each vertex, to closed loops of vertices."""
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


def _build_dome(rim: Array, crown_mm: float) -> Array:
    """Build 40 rings from a rim (N, 3) to an ellipsoid, and the top: (40 N + 1, 3)."""
    # Shares of the height from neck to crown: half the head's length and breadth, where it is
    # widest, and where the neck's shape ends.
    half_length, half_breadth, widest, neck_end = 0.36, 0.28, 0.52, 0.45
    waves = np.fft.rfft(rim, axis=0)  # the rim itself zigzags from face to face
    waves[5:] = 0.0
    line = np.fft.irfft(waves, len(rim), axis=0)
    centre = line[:, :2].mean(axis=0)
    arm, ahead = line[:, :2] - centre, np.roll(line, -1, axis=0)[:, :2] - line[:, :2]
    turns = np.sign((arm[:, 0] * ahead[:, 1] - arm[:, 1] * ahead[:, 0]).sum())
    angle = np.arctan2(arm[0, 1], arm[0, 0]) + turns * 2.0 * np.pi * np.arange(len(rim)) / len(rim)
    height = crown_mm - float(rim[:, 2].mean())
    ellipse = height * np.stack([half_length * np.cos(angle), half_breadth * np.sin(angle)], axis=1)
    rising = np.sin(np.linspace(0.0, np.pi / 2.0, 21))[:-1]
    below = widest * np.arange(1, 21) / 21
    level = np.concatenate([below, widest + (1 - widest) * rising])
    up = np.clip(level / neck_end, 0.0, 1.0)
    blend = (up * up * (3.0 - 2.0 * up))[:, None, None]
    narrowing = np.sqrt(1.0 - (np.maximum(level - widest, 0.0) / (1.0 - widest)) ** 2)
    flat = (1.0 - blend) * arm + blend * narrowing[:, None, None] * ellipse
    z = (1.0 - level[:, None]) * line[:, 2] + level[:, None] * crown_mm
    points = np.concatenate([centre + flat, z[..., None]], axis=-1)
    return np.concatenate([points.reshape(-1, 3), [[*centre, crown_mm]]])


def _stitch(rim: Indices, start: int, count: int) -> Indices:
    """Make faces from a rim, in the kept faces' direction, over rings from `start` on to a top."""
    size = len(rim)
    rings = [rim, *(start + np.arange(count - 1)).reshape(-1, size)]
    faces = []
    for lower, upper in pairwise(rings):
        low_next, up_next = np.roll(lower, -1), np.roll(upper, -1)
        faces += [np.stack([low_next, lower, upper], 1), np.stack([low_next, upper, up_next], 1)]
    top = np.full(size, start + count - 1)
    return np.concatenate([*faces, np.stack([np.roll(rings[-1], -1), rings[-1], top], axis=1)])
