"""Wavefront OBJ with vertex colours ("v x y z r g b", which most programs understand)."""

from __future__ import annotations

from pathlib import Path
from typing import IO

import numpy as np

from bodyscan.arrays import Indices
from bodyscan.body_model.skinned import SkinnedBody
from bodyscan.export.formats import BodyFormat
from bodyscan.files.atomic import atomic_replacement
from bodyscan.mesh.body import BodyMesh
from bodyscan.mesh.ply import describe_axes, lay_axes


def write_obj(path: Path, mesh: BodyMesh, up: str = "z") -> None:
    """Write a mesh in mm: positions to 0.1 um, normals and colours to four places."""
    with atomic_replacement(Path(path)) as temporary, temporary.open("wb") as stream:
        _write_vertices(stream, mesh, up)
        _write_faces(stream, mesh.faces)


def write_skinned_obj(path: Path, body: SkinnedBody, up: str = "z") -> None:
    """Write a registered body as the person stood: a group of faces for each part, in which order is
    the same for everybody, and the landmarks as points at its end, each a group."""
    with atomic_replacement(Path(path)) as temporary, temporary.open("wb") as stream:
        _write_vertices(stream, body.mesh, up)
        for part, name in enumerate(body.part_names):
            stream.write(f"g {name.replace(' ', '_')}\n".encode("ascii"))
            _write_faces(stream, body.mesh.faces[body.face_parts == part])
        stream.write(b"o landmarks\n")
        for number, landmark in enumerate(body.landmarks, start=len(body.mesh.vertices) + 1):
            name = landmark.name.replace(" ", "_")
            x, y, z = lay_axes(np.asarray(landmark.position), up)
            lines = f"g {name}\nv {x:.4f} {y:.4f} {z:.4f}\np {number}\n"
            stream.write(lines.encode("ascii"))


def _write_vertices(stream: IO[bytes], mesh: BodyMesh, up: str) -> None:
    stream.write(f"# {describe_axes(up)}\no body\n".encode("ascii"))
    points = np.column_stack([lay_axes(mesh.vertices, up), mesh.colours / 255.0])
    for word, rows in (("v", points), ("vn", lay_axes(mesh.normals, up))):
        # Adding 0 makes 0 of -0.
        rounded = np.round(rows.astype(np.float64), 4) + 0.0
        np.savetxt(stream, rounded, word + " %.4f" * rounded.shape[1])


def _write_faces(stream: IO[bytes], faces: Indices) -> None:
    np.savetxt(stream, np.repeat(faces + 1, 2, axis=1), "f" + " %d//%d" * 3)


FORMAT = BodyFormat(
    write_obj,
    holds=frozenset({"mesh", "colours", "normals"}),
    write_skinned=write_skinned_obj,
    free_axes=True,
)
