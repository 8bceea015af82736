"""Rings of a body's parts, and the branches that are in none."""

from __future__ import annotations

import networkx as nx
import numpy as np
import open3d as o3d
import pytest

from bodyscan.arrays import Indices
from bodyscan.mesh.rings import rings, without_branches


def test_what_is_left_without_branches_is_the_graph_s_core() -> None:
    rng = np.random.default_rng(5)
    for count in range(1, 60):
        joined = rng.integers(2 + count // 3, size=(count, 2))
        joined = joined[joined[:, 0] != joined[:, 1]]
        core = nx.k_core(nx.Graph(joined.tolist()), 2)
        assert _edges(without_branches(joined)) == {frozenset(edge) for edge in core.edges}


def test_a_ring_is_found_and_a_ball_has_none() -> None:
    upright = o3d.geometry.TriangleMesh.create_torus(150.0, 30.0, 60, 30)
    upright.rotate(upright.get_rotation_matrix_from_xyz((np.pi / 2.0, 0.0, 0.0)))
    found = rings(np.asarray(upright.vertices), np.asarray(upright.triangles, np.int64))
    assert len(found) == 1
    assert found[0].high_mm - found[0].low_mm > 200.0
    ball = o3d.geometry.TriangleMesh.create_sphere(150.0, 40)
    assert not rings(np.asarray(ball.vertices), np.asarray(ball.triangles, np.int64))


def upright_ring(radius_mm: float, at: tuple[float, float, float]) -> tuple[np.ndarray, Indices]:
    torus = o3d.geometry.TriangleMesh.create_torus(radius_mm, 0.25 * radius_mm, 60, 30)
    torus.rotate(torus.get_rotation_matrix_from_xyz((np.pi / 2.0, 0.0, 0.0)), (0.0, 0.0, 0.0))
    return np.asarray(torus.vertices) + at, np.asarray(torus.triangles, np.int64)


def test_a_ring_is_told_where_it_is() -> None:
    """From the lowest layer to the highest that its hole parts, and those that close it."""
    (one,) = rings(*upright_ring(120.0, (30.0, -70.0, 1000.0)))
    assert one.y_mm == pytest.approx(-70.0, abs=5.0)
    assert 0.5 * (one.low_mm + one.high_mm) == pytest.approx(1000.0, abs=10.0)
    # The hole is 180 mm high: of layers of 20 mm nine, and one on either side.
    assert one.high_mm - one.low_mm == pytest.approx(200.0, abs=20.0)


def test_rings_less_than_eight_centimetres_high_are_folds() -> None:
    small = upright_ring(40.0, (0.0, 0.0, 500.0))
    assert not rings(*small)
    assert len(rings(*small, smallest_mm=50.0)) == 1
    assert len(rings(*upright_ring(60.0, (0.0, 0.0, 500.0)))) == 1  # its hole is 90 mm high


def test_rings_come_from_the_lowest_up_and_beside_each_other_from_the_right() -> None:
    places = ((0.0, 200.0, 1000.0), (0.0, 0.0, 1400.0), (0.0, -200.0, 1000.0), (0.0, 0.0, 500.0))
    parts = [upright_ring(80.0, at) for at in places]
    vertices = np.concatenate([own for own, _ in parts])
    faces = np.concatenate([own + k * len(parts[0][0]) for k, (_, own) in enumerate(parts)])
    found = rings(vertices, faces)
    assert [round(ring.y_mm, -2) for ring in found] == [0.0, -200.0, 200.0, 0.0]
    assert np.diff([ring.low_mm for ring in found]).tolist() == [500.0, 0.0, 400.0]


def test_an_edge_longer_than_a_layer_makes_no_ring() -> None:
    """A tetrahedron 200 mm high, one of whose edges has a vertex half way up."""
    vertices = np.array([[0, 0, 0], [90, 0, 0], [0, 90, 0], [0, 0, 200], [0, 0, 100]], float)
    faces = [[0, 2, 1], [1, 2, 3], [0, 1, 4], [4, 1, 3], [2, 0, 4], [2, 4, 3]]
    assert not rings(vertices, np.array(faces))


def _edges(joined: Indices) -> set[frozenset[int]]:
    return {frozenset(edge) for edge in joined.tolist()}


def test_a_mesh_within_one_layer_has_no_ring() -> None:
    ball = o3d.geometry.TriangleMesh.create_sphere(5.0, 10)
    vertices = np.asarray(ball.vertices) + [0.0, 0.0, 1010.0]
    assert not rings(vertices, np.asarray(ball.triangles, np.int64), smallest_mm=0.0)
