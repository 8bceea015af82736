"""Signed distances to surfaces whose truth is a formula."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import open3d as o3d
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_bodies import cylinder, ellipsoid, mesh_of

from bodyscan.errors import BadInput, FailedWork
from bodyscan.evaluation.surface import (
    compare_surfaces,
    compute_signed_distances,
    find_covered_spots,
    fit_to_surface,
    sample_surface,
    summarize_deviation,
)
from bodyscan.geometry.transforms import RigidTransform

BOX = o3d.geometry.TriangleMesh.create_box(100.0, 200.0, 300.0)
VERTICES = np.asarray(BOX.vertices) + np.array([1000.0, -500.0, 2000.0])
FACES = np.asarray(BOX.triangles).astype(np.int64)
LOW, HIGH = VERTICES.min(axis=0), VERTICES.max(axis=0)


def box_distance(points: np.ndarray) -> np.ndarray:
    """Exact, negative inside."""
    beyond = np.maximum(LOW - points, points - HIGH)
    return np.linalg.norm(np.maximum(beyond, 0.0), axis=1) + np.minimum(beyond.max(axis=1), 0.0)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_distances_to_a_box(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform(LOW - 150.0, HIGH + 150.0, (200, 3))
    found = compute_signed_distances(points, VERTICES, FACES)
    # float32 around the box's own centre: 1e-4 mm at 300 mm, though the box stands 2 m away.
    np.testing.assert_allclose(found, box_distance(points), atol=1e-4)


def test_small_distances_keep_their_sign() -> None:
    points, normals = sample_surface(VERTICES, FACES, 2000)
    step = np.random.default_rng(1).uniform(0.001, 0.5, len(points)) * np.tile([1, -1], 1000)
    found = compute_signed_distances(points + step[:, None] * normals, VERTICES, FACES)
    # Near an edge another face may be nearer; no sign is ever wrong.
    assert (np.sign(found) == np.sign(step)).all()
    assert np.mean(np.abs(found - step) < 1e-4) > 0.98


@pytest.mark.parametrize("seed", range(10))
def test_a_point_beyond_a_corner_is_outside_however_obtuse_the_faces(seed: int) -> None:
    """Of a flattened tetrahedron: a corner's normal is that of its faces, each by its angle there."""
    rng = np.random.default_rng(seed)
    faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
    corners = 100.0 * rng.normal(size=(4, 3)) * [1.0, 1.0, 0.05]
    if np.linalg.det(corners[1:] - corners[0]) < 0.0:
        corners = corners[[0, 2, 1, 3]]
    sides = corners[faces[:, 1:]] - corners[faces[:, :1]]
    normals = np.cross(sides[:, 0], sides[:, 1])
    points = rng.uniform(corners.min(axis=0) - 30.0, corners.max(axis=0) + 30.0, (1000, 3))
    outside = np.einsum("pfk,fk->pf", points[:, None] - corners[faces[:, 0]], normals) > 0.0
    found = compute_signed_distances(points, corners, faces)
    assert np.array_equal(found > 0.0, outside.any(axis=1))


def test_points_on_one_side_of_a_round_surface_are_laid_onto_its_faces() -> None:
    """Seen from one side, as by one pair: the nearest corner's tangent plane lies outside a round
    surface, and would draw all of them that way."""
    vertices, faces = ellipsoid((60.0, 78.0, 120.0), (300.0, 100.0, 900.0), 30)
    points, normals = sample_surface(vertices, faces, 60_000)
    points = points[normals[:, 0] > 0.3]
    off = RigidTransform.from_rotation_vector([0.0, 0.002, 0.001], [-2.0, 1.0, 0.5])
    laid = fit_to_surface(off.apply(points), vertices, faces)
    away = laid.apply(off.apply(points)) - points
    assert np.abs(away.mean(axis=0)).max() < 0.005  # 0.135 by the corners


def uneven_body() -> tuple[np.ndarray, np.ndarray]:
    """No motion brings it onto itself, and its box's middle is not that of its vertices."""
    vertices, faces = ellipsoid((60.0, 80.0, 130.0), resolution=40)
    vertices[:, 0] *= np.where(vertices[:, 0] > 0.0, 1.8, 1.0)
    vertices[:, 2] *= np.where(vertices[:, 2] > 0.0, 1.5, 1.0)
    return vertices + [300.0, 100.0, 900.0], faces


def test_a_scan_that_stands_centimetres_off_is_laid_onto_the_surface() -> None:
    """By 25 mm and five degrees: two scans of somebody who stepped off and on again."""
    vertices, faces = uneven_body()
    points, _ = sample_surface(vertices, faces, 20_000)
    middle = RigidTransform.from_translation(np.array([300.0, 100.0, 900.0]))
    turned = RigidTransform.from_rotation_vector([0.05, -0.04, 0.06], [15.0, -18.0, 10.0])
    off = middle @ turned @ middle.inverse()
    laid = fit_to_surface(off.apply(points), vertices, faces)
    assert np.abs(laid.apply(off.apply(points)) - points).max() < 0.01


def test_a_front_that_nowhere_touches_the_surface_is_laid_onto_it() -> None:
    """Seen from one side and 20 mm off, so that no point lies within 5 mm of the surface."""
    vertices, faces = uneven_body()
    points, normals = sample_surface(vertices, faces, 40_000)
    points = points[normals[:, 0] > 0.3]
    laid = fit_to_surface(points + [20.0, 0.0, 0.0], vertices, faces)
    assert np.abs(laid.apply(points + [20.0, 0.0, 0.0]) - points).mean() < 0.05


def test_what_has_changed_by_millimetres_does_not_move_the_rest() -> None:
    """A tenth of the surface stands out by 3 mm: an arm held otherwise, a fold of cloth."""
    vertices, faces = uneven_body()
    points, normals = sample_surface(vertices, faces, 20_000)
    changed = points[:, 0] > np.quantile(points[:, 0], 0.9)
    laid = fit_to_surface(points + 3.0 * changed[:, None] * normals, vertices, faces)
    # 0.1 of 3 mm if all counted alike.
    assert np.abs(laid.apply(points) - points)[~changed].max() < 0.02


def test_statistics() -> None:
    found = summarize_deviation(np.array([0.0, 1.0, -1.0, 2.0]))
    assert found.count == 4
    assert found.bias_mm == pytest.approx(0.5)
    assert found.median_mm == pytest.approx(1.0)
    assert found.rms_mm == pytest.approx(np.sqrt(1.5))
    assert found.worst_mm == 2.0


def test_samples_are_uniform_in_area() -> None:
    points, normals = sample_surface(VERTICES, FACES, 50_000)
    np.testing.assert_allclose(box_distance(points), 0.0, atol=1e-9)
    ends = np.mean(np.abs(normals[:, 2]) > 0.5)
    # Top and bottom: 2 * 100 * 200 of 220,000 mm^2; 50,000 draws scatter by 0.17 %.
    assert ends == pytest.approx(40.0 / 220.0, abs=0.007)


def test_coverage_needs_points_near_along_the_normal() -> None:
    points, normals = sample_surface(VERTICES, FACES, 300_000, seed=5)
    spots = sample_surface(VERTICES, FACES, 5000)
    assert np.mean(find_covered_spots(points, *spots, 1.0, 4.0)) > 0.99
    lifted = points + 1.5 * normals
    assert np.mean(find_covered_spots(lifted, *spots, 1.0, 4.0)) < 0.05
    assert np.mean(find_covered_spots(lifted, *spots, 2.0, 4.0)) > 0.99


def write(path: Path, vertices: np.ndarray, faces: np.ndarray) -> Path:
    made = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(vertices), o3d.utility.Vector3iVector(faces.astype(np.int32))
    )
    o3d.io.write_triangle_mesh(str(path), made)
    return path


def test_only_the_measured_is_compared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The upper half of a body is filled, and lies a centimetre off."""
    vertices, faces = cylinder(50.0, 0.0, 400.0)
    filled = vertices[faces, 2].max(axis=1) > 200.0
    moved = vertices + np.where(vertices[:, 2:] > 200.0, [10.0, 0.0, 0.0], 0.0)
    other = write(tmp_path / "other.ply", vertices, faces)
    standing, fitted = compare_surfaces(mesh_of(moved, faces, filled), other)
    assert (standing.fitted, fitted.fitted) == (False, True)
    assert (standing.is_scan, standing.name) == (False, f"{tmp_path.name}/other.ply")
    for one in (standing, fitted):
        assert "z up: 400 mm tall" in one.notes[0]
        np.testing.assert_array_equal(one.vertices, np.unique(faces[~filled]))
        assert np.abs(one.signed_mm).max() < 0.01
    other = write(tmp_path / "other.ply", *cylinder(90.0, 0.0, 400.0))
    fitted = compare_surfaces(mesh_of(vertices, faces), other)[1]
    assert "half of the scan lies 4" in fitted.notes[-1]
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(FailedWork, match="pip install open3d"):
        compare_surfaces(mesh_of(moved, faces, filled), other)


@pytest.mark.parametrize(
    ("size_mm", "message"), [(79.2, "is 79.2 mm long"), (2008.0, "is 2,008 mm long")]
)
def test_what_is_a_fifth_or_five_times_as_large_is_not_the_same_subject(
    size_mm: float, message: str, tmp_path: Path
) -> None:
    """A body of 400 mm and a box; points without faces, or no file, are no surface either."""
    body = mesh_of(*cylinder(50.0, 0.0, 400.0))
    box = write(tmp_path / "box.ply", (VERTICES - LOW) / 300.0 * size_mm, FACES)
    with pytest.raises(BadInput, match=message):
        compare_surfaces(body, box)
    o3d.io.write_point_cloud(str(tmp_path / "points.ply"), o3d.geometry.PointCloud(BOX.vertices))
    for name in ("points.ply", "missing.ply"):
        with pytest.raises(BadInput, match="no surface can be read here"):
            compare_surfaces(body, tmp_path / name)
