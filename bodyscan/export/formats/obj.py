"""Wavefront OBJ with vertex colours ("v x y z r g b", which most programs understand) or a texture."""

from __future__ import annotations

from pathlib import Path
from typing import IO

import numpy as np

from bodyscan.arrays import Indices
from bodyscan.body_model.skinned import SkinnedBody
from bodyscan.export.formats import BodyFormat
from bodyscan.export.texture import Texture
from bodyscan.files.atomic import atomic_replacement, write_bytes, write_text
from bodyscan.mesh.body import BodyMesh
from bodyscan.mesh.ply import describe_axes, lay_axes


def write_obj(path: Path, mesh: BodyMesh, up: str = "z", texture: Texture | None = None) -> None:
    """Write a mesh in mm: positions to 0.1 um, normals and colours to four places."""
    with atomic_replacement(Path(path)) as temporary, temporary.open("wb") as stream:
        _start(stream, Path(path), mesh, up, texture)
        _write_faces(stream, mesh.faces, None if texture is None else texture.faces)


def write_skinned_obj(
    path: Path, body: SkinnedBody, up: str = "z", texture: Texture | None = None
) -> None:
    """Write a registered body as the person stood: a group of faces for each part, in which order is
    the same for everybody, and the landmarks as points at its end, each a group."""
    with atomic_replacement(Path(path)) as temporary, temporary.open("wb") as stream:
        _start(stream, Path(path), body.mesh, up, texture)
        for part, name in enumerate(body.part_names):
            stream.write(f"g {name.replace(' ', '_')}\n".encode("ascii"))
            its = body.face_parts == part
            places = None if texture is None else texture.faces[its]
            _write_faces(stream, body.mesh.faces[its], places)
        stream.write(b"o landmarks\n")
        for number, landmark in enumerate(body.landmarks, start=len(body.mesh.vertices) + 1):
            name = landmark.name.replace(" ", "_")
            x, y, z = lay_axes(np.asarray(landmark.position), up)
            lines = f"g {name}\nv {x:.4f} {y:.4f} {z:.4f}\np {number}\n"
            stream.write(lines.encode("ascii"))


def _start(stream: IO[bytes], path: Path, mesh: BodyMesh, up: str, texture: Texture | None) -> None:
    """Write vertices with colours, or an MTL and a PNG beside the file, and where they are used."""
    if texture is None:
        _write_vertices(stream, mesh, up, coloured=True)
        return
    image, material = path.with_suffix(".png"), path.with_suffix(".mtl")
    write_bytes(image, texture.png)
    lines = ("newmtl body", "Ka 1 1 1", "Kd 1 1 1", "Ks 0 0 0", "illum 1", f"map_Kd {image.name}")
    write_text(material, "\n".join((*lines, "")))
    stream.write(f"mtllib {material.name}\n".encode())
    _write_vertices(stream, mesh, up, coloured=False)
    # Images have their origin at the top, OBJ below.
    places = np.column_stack([texture.uv[:, 0], 1.0 - texture.uv[:, 1]])
    np.savetxt(stream, places, "vt %.6f %.6f")
    stream.write(b"usemtl body\n")


def _write_vertices(stream: IO[bytes], mesh: BodyMesh, up: str, *, coloured: bool) -> None:
    stream.write(f"# {describe_axes(up)}\no body\n".encode("ascii"))
    points = lay_axes(mesh.vertices, up)
    points = np.column_stack([points, mesh.colours / 255.0]) if coloured else points
    for word, rows in (("v", points), ("vn", lay_axes(mesh.normals, up))):
        # Adding 0 makes 0 of -0.
        rounded = np.round(rows.astype(np.float64), 4) + 0.0
        np.savetxt(stream, rounded, word + " %.4f" * rounded.shape[1])


def _write_faces(stream: IO[bytes], faces: Indices, places: Indices | None) -> None:
    """Write faces (F, 3), whose vertices have normals, and places in an image if these are given."""
    if places is None:
        np.savetxt(stream, np.repeat(faces + 1, 2, axis=1), "f" + " %d//%d" * 3)
    else:
        corners = np.stack([faces, places, faces], axis=2) + 1
        np.savetxt(stream, corners.reshape(-1, 9), "f" + " %d/%d/%d" * 3)


FORMAT = BodyFormat(
    write_obj,
    holds=frozenset({"mesh", "colours", "normals", "texture"}),
    write_skinned=write_skinned_obj,
    free_axes=True,
)
