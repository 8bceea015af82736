"""A coarse ball brought nearer to a fine one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import open3d as o3d

from bodyscan.mesh.body import BodyMesh
from bodyscan.mesh.decimation import NearestSurface, decimate, refine_to_tolerance
from bodyscan.mesh.topology import topology, vertex_normals


def ball(resolution: int) -> tuple[np.ndarray, np.ndarray]:
    mesh = o3d.geometry.TriangleMesh.create_sphere(100.0, resolution)
    return np.asarray(mesh.vertices) + [900.0, 0.0, 1500.0], np.asarray(mesh.triangles).astype(int)


def farthest(one: tuple[np.ndarray, np.ndarray], other: tuple[np.ndarray, np.ndarray]) -> float:
    vertices, faces = one
    a, b = np.random.default_rng(0).random((2, len(faces), 1))
    a, b = np.where(a + b > 1, 1 - a, a), np.where(a + b > 1, 1 - b, b)
    corners = vertices[faces]
    inside = (
        corners[:, 0] + a * (corners[:, 1] - corners[:, 0]) + b * (corners[:, 2] - corners[:, 0])
    )
    return float(NearestSurface(*other).nearest(np.concatenate([vertices, inside]))[1].max())


def test_a_coarse_ball_comes_within_the_limit() -> None:
    fine, coarse = ball(100), ball(10)
    assert farthest(coarse, fine) > 2.0
    found = refine_to_tolerance(*coarse, *fine, 0.5)
    assert farthest(found, fine) < 0.55
    assert farthest(fine, found) < 0.55
    check = topology(*found)
    assert check.manifold
    assert check.euler == 2
    # Flat faces within half a millimetre of a ball of 100 mm have edges of about 17 mm.
    assert len(found[1]) < 4000


def test_what_is_near_enough_stays() -> None:
    fine, coarse = ball(60), ball(40)
    vertices, faces = refine_to_tolerance(*coarse, *fine, 1.0)
    np.testing.assert_array_equal(faces, coarse[1])
    np.testing.assert_array_equal(vertices, coarse[0])


def test_one_bad_place_costs_a_few_faces_only() -> None:
    fine, coarse = ball(60), ball(60)
    dented = coarse[0].copy()
    dent = int(np.argmax(dented[:, 0]))
    dented[dent, 0] -= 5.0
    vertices, faces = refine_to_tolerance(dented, coarse[1], *fine, 0.3)
    assert farthest((vertices, faces), fine) < 0.3
    assert len(faces) <= len(coarse[1]) + 20


def test_the_same_input_gives_the_same_bytes() -> None:
    one, other = (refine_to_tolerance(*ball(10), *ball(60), 0.5) for _ in range(2))
    assert one[0].tobytes() == other[0].tobytes()
    assert one[1].tobytes() == other[1].tobytes()


def test_a_spike_that_was_lost_comes_back() -> None:
    fine, coarse = ball(60), ball(20)
    spiked = fine[0].copy()
    tip = int(np.argmax(spiked[:, 1]))
    spiked[tip, 1] += 3.0
    found = refine_to_tolerance(*coarse, spiked, fine[1], 0.5)
    assert farthest((spiked, fine[1]), found) < 0.55
    assert topology(*found).manifold


def test_the_same_mesh_read_twice_is_decimated_once() -> None:
    vertices, faces = ball(30)
    shape = len(vertices), 3
    some = BodyMesh(
        vertices,
        faces,
        vertex_normals(vertices, faces),
        np.zeros(shape, np.uint8),
        np.full(len(vertices), 0.1, np.float32),
        np.zeros(len(faces), bool),
    )
    small = decimate(some, faces=1000, within_mm=2.0)
    assert len(small.faces) < 1100
    assert decimate(replace(some, vertices=vertices.copy()), faces=1000, within_mm=2.0) is small
    darker = replace(some, colours=np.ones(shape, np.uint8))
    assert decimate(darker, faces=1000, within_mm=2.0).colours.min() == 1


def test_what_falls_apart_is_its_largest_piece() -> None:
    """Two balls, one of them small; each closed by itself."""
    large, small = ball(40), ball(12)
    vertices = np.concatenate([large[0], 0.2 * small[0]])
    faces = np.concatenate([large[1], small[1] + len(large[0])])
    blank = np.zeros((len(vertices), 3), np.uint8)
    mesh = BodyMesh(
        vertices, faces, vertex_normals(vertices, faces), blank,
        np.full(len(vertices), 0.1, np.float32), np.zeros(len(faces), bool),
    )  # fmt: skip
    found = decimate(mesh, faces=2000, within_mm=2.0)
    shape = topology(found.vertices, found.faces)
    assert (shape.manifold, shape.components) == (True, 1)
