"""Meshes of other programs: read, checked, and mended where only one thing can be meant."""

from __future__ import annotations

import math
import os
from pathlib import Path

import numpy as np

from bodyscan.arrays import Array, Indices
from bodyscan.errors import BadInput
from bodyscan.mesh.body_frame import is_upright
from bodyscan.mesh.slices import MeshSlicer
from bodyscan.mesh.topology import (
    UNSOUND,
    compute_face_areas,
    compute_signed_volume,
    drop_unused_vertices,
    find_fault,
    find_twins,
    label_components,
)
from bodyscan.outcome import Outcome

UNITS_MM = {"millimetres": 1.0, "centimetres": 10.0, "inches": 25.4, "feet": 304.8, "metres": 1e3}
PERSON_MM = (300.0, 1700.0, 3000.0)
"""The longest side of a person: at least, usually, at most."""


def read_surface(
    path: Path, unit: str, sizes_mm: tuple[float, float, float] = PERSON_MM, along: int = 2
) -> Outcome[tuple[Array, Indices]]:
    """Read vertices (V, 3), in the file's unit, and faces (F, 3), outwards.

    Vertices at one place are joined, faces without area between them and vertices that no face uses
    are dropped, and faces that all run inwards are turned. The notes say so, which faces do not go
    together, and what the file was taken as. Raises BadInput, which names the vertex or face.

    unit: of `UNITS_MM`.
    sizes_mm: what the longest side is at least, usually, and at most.
    along: the axis along which it extends farthest: z, who stands.
    """
    from trimesh import load_mesh  # takes half a second to load

    vertices, faces, cause = np.zeros((0, 3)), np.zeros((0, 3), np.int64), ""
    if path.is_file():
        try:
            read = load_mesh(path, process=False)
            vertices, faces = np.array(read.vertices, float), np.array(read.faces, np.int64)
        except Exception as error:  # whatever a damaged file makes of its parser
            cause = f" ({error})"
        if path.suffix.lower() == ".ply" and cause:  # or its faces have various numbers of corners
            vertices, faces = _read_polygons(path)
    fault = find_fault(vertices, faces) if faces.size else f"no surface can be read here{cause}"
    if fault:
        remedy = "give a PLY with faces, sound where it was made, z up"
        raise BadInput(fault, where=str(path), remedy=remedy)
    vertices, faces, notes = _mend(vertices, faces)
    lowest, expected, highest = sizes_mm
    size, scale = float(np.ptp(vertices, axis=0).max()), UNITS_MM[unit]
    if not lowest < size * scale < highest:
        fits = [name for name, mm in UNITS_MM.items() if lowest < size * mm < highest]
        meant = min(fits, key=lambda n: abs(math.log(size * UNITS_MM[n] / expected)), default=None)
        remedy = f"give a surface of such a subject, in {unit}"
        if meant is not None:
            factor = UNITS_MM[meant] / scale
            remedy += f"; if this one is in {meant}, multiply its coordinates by {factor:.6g}"
        what = f"is {size * scale:,.4g} mm long if read as {unit}; expected {lowest:,.0f} to "
        raise BadInput(f"{what}{highest:,.0f} mm", where=str(path), remedy=remedy)
    # Pieces beside each other, such as two balls, do not lie: the largest tells.
    label = label_components(faces, len(vertices))
    largest = np.argmax(np.bincount(label, compute_face_areas(vertices, faces)))
    if not is_upright(vertices, faces[label == largest], along):
        what = f"does not extend farthest along {'xyz'[along]}: it lies on its side"
        raise BadInput(what, where=str(path), remedy="turn it so that z is up")
    if _is_upside_down(vertices, faces):
        what = "has two feet at its top and a head below: it stands on its head, or -z is up"
        raise BadInput(what, where=str(path), remedy="turn it so that z is up")
    notes.append(f"taken as {unit}, z up: {scale * np.ptp(vertices[:, 2]):,.0f} mm tall")
    return Outcome((vertices, faces), tuple(f"{path}: {note}" for note in notes))


def _read_polygons(path: Path) -> tuple[Array, Indices]:
    """Read a PLY, its polygons as triangles, by Open3D, whose parser always prints its errors."""
    from open3d import io, utility

    errors, quiet = os.dup(2), utility.VerbosityContextManager(utility.VerbosityLevel.Error)
    try:
        with open(os.devnull, "w") as nowhere, quiet:
            os.dup2(nowhere.fileno(), 2)
            polygons = io.read_triangle_mesh(str(path))
    finally:
        os.dup2(errors, 2)
        os.close(errors)
    return np.array(polygons.vertices), np.array(polygons.triangles, int)


def _is_upside_down(vertices: Array, faces: Indices) -> bool:
    """Whether there are two feet at the top and one head below; raised hands have feet below."""
    slicer = MeshSlicer(vertices - vertices.min(axis=0), faces)
    heights = np.multiply((0.03, 0.06, 0.94, 0.97), np.ptp(vertices[:, 2])).tolist()
    return [sum(loop.area_mm2 > 0.0 for loop in slicer.slice(z)) for z in heights] == [1, 1, 2, 2]


def _mend(vertices: Array, faces: Indices) -> tuple[Array, Indices, list[str]]:
    """Join, drop and turn as `read_surface` says; also what was done. What is sound stays as it is."""
    notes = []
    distinct, same = np.unique(vertices, axis=0, return_inverse=True)
    if len(distinct) < len(vertices):
        doubled = len(vertices) - len(distinct)
        notes.append(f"merged {doubled} duplicate vertices")
        vertices, faces = distinct, same.reshape(-1)[faces]
    flat = (faces == np.roll(faces, 1, axis=1)).any(axis=1)
    if flat.any():
        first = flat.argmax()
        notes.append(f"{flat.sum()} faces name a vertex twice (the first is {first}): dropped")
        faces = faces[~flat]
    count = len(vertices)
    vertices, faces, _ = drop_unused_vertices(vertices, faces)
    if len(vertices) < count:
        notes.append(f"removed {count - len(vertices)} unreferenced vertices")
    unsound = np.flatnonzero((find_twins(faces, len(vertices)) == UNSOUND).any(axis=1))
    if unsound.size:
        notes.append(
            f"{unsound.size} faces, such as {unsound[0]}, run against a neighbour or share an edge "
            "with two: what is inside may be taken as outside there"
        )
    # 0.03 for a person, less where some of it is missing, and 0 for a flat sheet, which has no inside.
    inside = compute_signed_volume(vertices - vertices.mean(axis=0), faces)
    if inside < -1e-3 * compute_face_areas(vertices, faces).sum() ** 1.5:
        notes.append("faces pointed inwards: flipped")
        faces = np.ascontiguousarray(faces[:, ::-1])
    return vertices, faces, notes
