"""Wavefront OBJ with vertex colours ("v x y z r g b", which most programs understand)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bodyscan.export.formats import BodyFormat
from bodyscan.files.atomic import atomic_replacement
from bodyscan.mesh.body import BodyMesh


def write_obj(path: Path, mesh: BodyMesh) -> None:
    """Write a mesh in mm, rig frame: positions to 0.1 um, normals and colours to four places."""
    points = np.column_stack([mesh.vertices, mesh.colours / 255.0])
    with atomic_replacement(Path(path)) as temporary, temporary.open("wb") as stream:
        stream.write(b"# bodyscan: mm, x the way the subject faces, z up, floor at z = 0\n")
        stream.write(b"o body\n")
        for word, rows in (("v", points), ("vn", mesh.normals)):
            # Adding 0 makes 0 of -0.
            rounded = np.round(rows.astype(np.float64), 4) + 0.0
            np.savetxt(stream, rounded, word + " %.4f" * rounded.shape[1])
        np.savetxt(stream, np.repeat(mesh.faces + 1, 2, axis=1), "f" + " %d//%d" * 3)


FORMAT = BodyFormat(write_obj, holds=frozenset({"mesh", "colours", "normals"}))
