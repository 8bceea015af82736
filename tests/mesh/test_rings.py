"""Rings of a body's parts, and the branches that are in none."""

from __future__ import annotations

import networkx as nx
import numpy as np
import open3d as o3d

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


def _edges(joined: Indices) -> set[frozenset[int]]:
    return {frozenset(edge) for edge in joined.tolist()}
