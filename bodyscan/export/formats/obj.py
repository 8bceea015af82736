"""Wavefront OBJ with vertex colours ("v x y z r g b", which most programs understand)."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from bodyscan.export.body_format import BodyFormat
from bodyscan.export.decimal_text import format_decimals, format_integers, join_columns
from bodyscan.files.atomic import atomic_replacement
from bodyscan.mesh.body import BodyMesh

ROWS = 200_000  # written at a time


def write_obj(path: Path, mesh: BodyMesh) -> None:
    """Write a mesh in mm, rig frame: positions to 0.1 um, normals and colours to four places."""
    with atomic_replacement(Path(path)) as temporary, temporary.open("wb") as stream:
        stream.write(b"# bodyscan: mm, x the way the subject faces, z up, floor at z = 0\n")
        stream.write(b"o body\n")
        for rows in _blocks(len(mesh.vertices)):
            columns = [*mesh.vertices[rows].T, *(mesh.colours[rows].T / 255.0)]
            numbers = [part for column in columns for part in (" ", format_decimals(column, 4))]
            stream.write(join_columns(["v", *numbers, "\n"]))
        for rows in _blocks(len(mesh.normals)):
            numbers = [
                p for column in mesh.normals[rows].T for p in (" ", format_decimals(column, 4))
            ]
            stream.write(join_columns(["vn", *numbers, "\n"]))
        for rows in _blocks(len(mesh.faces)):
            corners = [format_integers(corner) for corner in mesh.faces[rows].T + 1]
            numbers = [part for corner in corners for part in (" ", corner, "//", corner)]
            stream.write(join_columns(["f", *numbers, "\n"]))


def _blocks(count: int) -> Iterator[slice]:
    return (slice(start, start + ROWS) for start in np.arange(0, count, ROWS).tolist())


FORMAT = BodyFormat(write_obj, holds=frozenset({"mesh", "colours", "normals"}))
