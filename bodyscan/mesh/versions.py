"""Other versions of a body mesh: a light one, and one with only what was measured."""

from __future__ import annotations

import numpy as np
import open3d as o3d
from scipy.spatial import cKDTree

from bodyscan.errors import ScanFailed
from bodyscan.mesh.body import BodyMesh
from bodyscan.mesh.faithfulness import brought_within
from bodyscan.mesh.repair import largest_piece
from bodyscan.mesh.topology import topology, vertex_normals, without_unused

SPARE = 0.03  # of the faces are kept for where the decimated mesh strays


def light(mesh: BodyMesh, *, faces: int = 50_000, within_mm: float = 0.19) -> BodyMesh:
    """A closed mesh of about `faces` faces, `within_mm` from the full one.

    Quadric decimation (Garland and Heckbert 1997), which knows no such limit, and a few more faces
    where it went too far (some hundred at 50,000; many more where so few faces cannot do). Vertices
    take colour and sigma from the nearest vertex of the full mesh. A mesh that is small enough is
    returned as it is.
    Raises ScanFailed if the surface does not stay closed.
    """
    if len(mesh.faces) <= faces:
        return mesh
    full = o3d.t.geometry.TriangleMesh(
        o3d.core.Tensor(mesh.vertices), o3d.core.Tensor(mesh.faces.astype(np.int32))
    )
    reduced = full.simplify_quadric_decimation(1.0 - (1.0 - SPARE) * faces / len(mesh.faces))
    vertices = reduced.vertex.positions.numpy().astype(np.float64)
    corners = reduced.triangle.indices.numpy().astype(np.int64)
    found = topology(vertices, corners)
    if not found.manifold or found.components > 1:
        # Where surfaces nearly touch (between fingers) a collapse may fold one onto the other.
        vertices, corners = largest_piece(vertices, corners)
        found = topology(vertices, corners)
    if not found.manifold:
        raise ScanFailed(
            f"the mesh did not stay closed when reduced to {faces} faces ({found})",
            remedy="Ask for more faces.",
        )
    vertices, corners = brought_within(vertices, corners, mesh.vertices, mesh.faces, within_mm)
    nearest = np.asarray(cKDTree(mesh.vertices).query(vertices, workers=2)[1])
    sigma_mm = mesh.sigma_mm[nearest]
    return BodyMesh(
        vertices,
        corners,
        vertex_normals(vertices, corners),
        mesh.colours[nearest],
        sigma_mm,
        np.any(np.isnan(sigma_mm)[corners], axis=1),
    )


def measured_only(mesh: BodyMesh) -> BodyMesh:
    """The open surface that is left without the filled faces."""
    vertices, faces, used = without_unused(mesh.vertices, mesh.faces[~mesh.filled])
    return BodyMesh(
        vertices,
        faces,
        mesh.normals[used],
        mesh.colours[used],
        mesh.sigma_mm[used],
        np.zeros(len(faces), bool),
    )
