"""Decimated meshes: near the full one, closed, and hardly ever through themselves."""

from __future__ import annotations

import numpy as np
import open3d as o3d
import pytest
from made_bodies import arrays, mesh_of, together

from benchmarks.self_intersections import self_intersections
from bodyscan.evaluation.surface import deviation, signed_distances
from bodyscan.mesh.body import BodyMesh
from bodyscan.mesh.repair import decimate
from bodyscan.mesh.topology import compute_topology


def ball(resolution: int) -> tuple[np.ndarray, np.ndarray]:
    vertices, faces = arrays(o3d.geometry.TriangleMesh.create_sphere(100.0, resolution))
    return vertices + [900.0, 0.0, 1500.0], faces


def test_of_a_mesh_that_falls_apart_the_largest_piece_is_kept() -> None:
    """Two balls, one of them small; each closed by itself."""
    large, small = ball(40), ball(12)
    found = decimate(mesh_of(*together(large, (0.2 * small[0], small[1]))), faces=2000)
    shape = compute_topology(found.vertices, found.faces)
    assert (shape.manifold, shape.components) == (True, 1)


def test_the_light_version_is_close_and_closed(body: BodyMesh) -> None:
    lean = decimate(body, faces=20_000)
    assert abs(len(lean.faces) - 20_000) <= 20
    found = compute_topology(lean.vertices, lean.faces)
    assert found.manifold
    assert found.components == 1
    assert found.volume_mm3 == pytest.approx(
        compute_topology(body.vertices, body.faces).volume_mm3, rel=2e-3
    )
    errors = deviation(signed_distances(lean.vertices, body.vertices, body.faces))
    # Faces of 12 mm: on a radius of 40 mm a flat one is off by up to 0.3 mm.
    assert errors.p95_mm < 0.3
    assert errors.worst_mm <= 1.5
    back = signed_distances(body.vertices, lean.vertices, lean.faces)
    assert np.percentile(np.abs(back), 99.9) <= 0.7
    # A vertex set beside an edge may fold a face there, at fingers as thick as one face: 0.2 % of
    # 30,000 edges (35 here, some through several faces). At full size, with 50,000 faces, there are
    # next to none: docs/results.md.
    pierced = self_intersections(lean.vertices, lean.faces)
    assert len(np.unique(pierced[:, :2], axis=0)) <= 60
    assert lean.filled_share == pytest.approx(body.filled_share, abs=0.05)
    np.testing.assert_array_equal(lean.filled, np.isnan(lean.sigma_mm)[lean.faces].any(axis=1))


def test_a_small_mesh_stays_as_it_is(body: BodyMesh) -> None:
    assert decimate(body, faces=len(body.faces)) is body


def test_a_reduction_that_folds_is_mended() -> None:
    # A thin wavy sheet: its two sides collapse onto each other, and Open3D leaves an open fold.
    sphere = o3d.geometry.TriangleMesh.create_sphere(1.0, resolution=60)
    vertices = np.asarray(sphere.vertices) * [100.0, 60.0, 0.05]
    vertices[:, 2] += 3.0 * np.sin(vertices[:, 0] / 8.0) * np.cos(vertices[:, 1] / 5.0)
    faces = np.asarray(sphere.triangles).astype(np.int64)
    sheet = mesh_of(vertices, faces)
    reduced = decimate(sheet, faces=1000)
    found = compute_topology(reduced.vertices, reduced.faces)
    assert found.manifold
    assert found.components == 1
