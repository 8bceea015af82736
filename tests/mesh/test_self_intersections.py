"""Meshes that pass through themselves in known places."""

from __future__ import annotations

import numpy as np
import open3d as o3d
import pytest

from benchmarks.self_intersections import self_intersections


def ball(centre: tuple[float, float, float], radius: float) -> tuple[np.ndarray, np.ndarray]:
    mesh = o3d.geometry.TriangleMesh.create_sphere(radius, resolution=12).translate(centre)
    return np.asarray(mesh.vertices), np.asarray(mesh.triangles).astype(np.int64)


def together(*bodies: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    starts = np.cumsum([0, *[len(vertices) for vertices, _ in bodies]])
    return (
        np.concatenate([vertices for vertices, _ in bodies]),
        np.concatenate([faces + start for (_, faces), start in zip(bodies, starts, strict=False)]),
    )


def test_a_ball_and_two_apart_do_not() -> None:
    assert len(self_intersections(*ball((900.0, 50.0, 1500.0), 40.0))) == 0
    apart = together(ball((900.0, 50.0, 1500.0), 40.0), ball((900.0, 131.0, 1500.0), 40.0))
    assert len(self_intersections(*apart)) == 0


def test_two_balls_meet_along_a_circle() -> None:
    distance, radius = 50.0, 40.0
    vertices, faces = together(ball((0.0, 0.0, 0.0), radius), ball((0.0, distance, 1.0), radius))
    found = self_intersections(vertices, faces)
    assert len(found) > 20
    middles = vertices[found[:, :2]].mean(axis=1)
    # The circle's plane lies halfway; edges are up to 11 mm long.
    assert np.abs(middles[:, 1] - 25.0).max() < 11.0
    assert np.linalg.norm(middles[:, [0, 2]], axis=1).mean() == pytest.approx(31.0, abs=4.0)


def test_a_vertex_pulled_through_the_other_side() -> None:
    vertices, faces = ball((0.0, 0.0, 0.0), 40.0)
    pulled = int(np.argmax(vertices[:, 0]))
    vertices = vertices.copy()
    vertices[pulled] = [-50.0, 1.0, 2.0]
    found = self_intersections(vertices, faces)
    # All its edges go through the far side.
    about = (faces == pulled).any(axis=1).sum()
    assert np.count_nonzero((found[:, :2] == pulled).any(axis=1)) == about
