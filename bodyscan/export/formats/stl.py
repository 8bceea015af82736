"""Binary STL."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bodyscan.export.formats import BodyFormat
from bodyscan.files.atomic import atomic_replacement
from bodyscan.mesh.body import BodyMesh
from bodyscan.mesh.ply import describe_axes, lay_axes
from bodyscan.mesh.topology import compute_face_normals


def write_stl(path: Path, mesh: BodyMesh, up: str = "z") -> None:
    """Write a mesh in mm. STL has no colours, vertex normals or filled faces."""
    kind = [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")]
    vertices = lay_axes(mesh.vertices, up)
    cross = compute_face_normals(vertices, mesh.faces)
    length = np.linalg.norm(cross, axis=1, keepdims=True)
    triangles = np.zeros(len(mesh.faces), kind)
    triangles["normal"] = cross / np.where(length > 0, length, 1.0)
    triangles["corners"] = vertices[mesh.faces]
    with atomic_replacement(Path(path)) as temporary, temporary.open("wb") as stream:
        stream.write(describe_axes(up).encode("ascii").ljust(80, b"\0"))
        stream.write(np.uint32(len(triangles)).astype("<u4").tobytes())
        stream.write(triangles.data)


FORMAT = BodyFormat(write_stl, holds=frozenset({"mesh"}), free_axes=True)
