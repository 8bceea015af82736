"""The light and the open version of a body mesh."""

from __future__ import annotations

import numpy as np
import open3d as o3d
import pytest
from made_bodies import mesh_of

from benchmarks.self_intersections import self_intersections
from bodyscan.evaluation.surface import deviation, signed_distances
from bodyscan.mesh.body import BodyMesh
from bodyscan.mesh.decimation import decimate
from bodyscan.mesh.topology import face_areas, topology


def filled_share(mesh: BodyMesh) -> float:
    areas = face_areas(mesh.vertices, mesh.faces)
    return float(areas[mesh.filled].sum() / areas.sum())


def test_the_light_version_is_close_and_closed(body: BodyMesh) -> None:
    lean = decimate(body, faces=20_000, within_mm=0.5)
    # What the spare faces were not needed for, or more than them.
    assert abs(len(lean.faces) - 20_000) <= 600
    found = topology(lean.vertices, lean.faces)
    assert found.manifold
    assert found.components == 1
    assert found.volume_mm3 == pytest.approx(
        topology(body.vertices, body.faces).volume_mm3, rel=2e-3
    )
    off = deviation(signed_distances(lean.vertices, body.vertices, body.faces))
    # Faces of 12 mm: on a radius of 40 mm a flat one is off by up to 0.3 mm.
    assert off.p95_mm < 0.3
    assert off.worst_mm <= 0.5
    back = signed_distances(body.vertices, lean.vertices, lean.faces)
    assert np.abs(back).max() <= 0.5 + 1e-3
    # A vertex set beside an edge may fold a face there, at fingers as thick as one face: 0.2 % of
    # 30,000 edges (35 here, some through several faces). At full size, with 50,000 faces, there are
    # next to none: docs/results.md.
    pierced = self_intersections(lean.vertices, lean.faces)
    assert len(np.unique(pierced[:, :2], axis=0)) <= 60
    # Of the area: the light mesh has its faces where the body is curved, at fingers and toes.
    assert filled_share(lean) == pytest.approx(filled_share(body), abs=0.05)
    np.testing.assert_array_equal(lean.filled, np.isnan(lean.sigma_mm)[lean.faces].any(axis=1))


def test_a_small_mesh_stays_as_it_is(body: BodyMesh) -> None:
    assert decimate(body, faces=len(body.faces)) is body


def test_the_open_version_is_what_was_measured(body: BodyMesh) -> None:
    measured = body.measured_part()
    assert len(measured.faces) == np.count_nonzero(~body.filled)
    assert not measured.filled.any()
    assert np.isfinite(measured.sigma_mm).all()
    assert not topology(measured.vertices, measured.faces).closed
    np.testing.assert_array_equal(
        measured.vertices[measured.faces], body.vertices[body.faces[~body.filled]]
    )
    np.testing.assert_array_equal(
        measured.colours[measured.faces], body.colours[body.faces[~body.filled]]
    )


def test_a_reduction_that_folds_is_mended() -> None:
    # A thin wavy sheet: its two sides collapse onto each other, and Open3D leaves an open fold.
    sphere = o3d.geometry.TriangleMesh.create_sphere(1.0, resolution=60)
    vertices = np.asarray(sphere.vertices) * [100.0, 60.0, 0.05]
    vertices[:, 2] += 3.0 * np.sin(vertices[:, 0] / 8.0) * np.cos(vertices[:, 1] / 5.0)
    faces = np.asarray(sphere.triangles).astype(np.int64)
    sheet = mesh_of(vertices, faces)
    reduced = decimate(sheet, faces=1000)
    found = topology(reduced.vertices, reduced.faces)
    assert found.manifold
    assert found.components == 1
