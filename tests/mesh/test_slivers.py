"""Faces without area go, and the mesh stays closed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from made_scan import egg

from bodyscan.export.body_file import Provenance, write_body
from bodyscan.mesh.body import BodyMesh
from bodyscan.mesh.slivers import without_slivers
from bodyscan.mesh.topology import directed_edges, face_areas


def pinched() -> tuple[BodyMesh, BodyMesh]:
    """An egg, and the same with both ends of one of its edges within a ten-thousandth of a mm."""
    whole = egg(resolution=12)
    vertices = np.round(whole.vertices, 3)
    a, b = whole.faces[40, :2]
    vertices[b] = vertices[a] + 2e-5
    return whole, replace(whole, vertices=vertices)


def test_the_edge_is_drawn_together_and_the_mesh_stays_closed() -> None:
    _, mesh = pinched()
    found = without_slivers(mesh)
    assert len(found.faces) == len(mesh.faces) - 2
    assert len(found.vertices) == len(mesh.vertices) - 1 == len(found.sigma_mm)
    assert len(found.filled) == len(found.faces)
    edges = {tuple(edge) for edge in directed_edges(found.faces).tolist()}
    assert edges == {(b, a) for a, b in edges}
    np.testing.assert_allclose(
        np.ptp(found.vertices, axis=0), np.ptp(mesh.vertices, axis=0), atol=1e-4
    )


def test_a_sound_mesh_is_left_alone() -> None:
    whole, _ = pinched()
    assert without_slivers(whole) is whole


def test_no_face_of_an_exported_obj_is_without_area(tmp_path: Path) -> None:
    _, mesh = pinched()
    write_body(tmp_path / "body.obj", mesh, Provenance(None, "01"))
    rows = [line.split() for line in (tmp_path / "body.obj").read_text().splitlines()]
    vertices = np.array([row[1:4] for row in rows if row[0] == "v"], float)
    faces = np.array([[int(c.split("/")[0]) - 1 for c in row[1:]] for row in rows if row[0] == "f"])
    assert face_areas(vertices, faces).min() > 0.0
