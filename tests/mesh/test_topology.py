"""Small surfaces whose topology is known."""

from __future__ import annotations

import numpy as np
import open3d as o3d
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bodyscan.mesh.topology import (
    drop_unused_vertices,
    face_components,
    face_normals,
    signed_volume,
    topology,
    vertex_normals,
)

CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
TETRAHEDRON = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])


def arrays(mesh: o3d.geometry.TriangleMesh) -> tuple[np.ndarray, np.ndarray]:
    return np.asarray(mesh.vertices), np.asarray(mesh.triangles).astype(np.int64)


def test_a_tetrahedron() -> None:
    found = topology(CORNERS, TETRAHEDRON)
    assert found.closed
    assert found.manifold
    assert (found.components, found.euler) == (1, 2)
    assert found.volume_mm3 == pytest.approx(1 / 6)


def test_a_torus_has_a_handle() -> None:
    found = topology(*arrays(o3d.geometry.TriangleMesh.create_torus(30.0, 10.0)))
    assert found.manifold
    assert (found.components, found.euler) == (1, 0)


@given(missing=st.integers(0, 3))
def test_a_missing_face_opens_it(missing: int) -> None:
    found = topology(CORNERS, np.delete(TETRAHEDRON, missing, axis=0))
    assert not found.closed
    assert not found.manifold
    assert found.euler == 1


@given(turned=st.integers(0, 3))
def test_a_turned_face_is_found(turned: int) -> None:
    faces = TETRAHEDRON.copy()
    faces[turned] = faces[turned, ::-1]
    assert not topology(CORNERS, faces).closed


def test_all_faces_turned_is_closed_but_inside_out() -> None:
    found = topology(CORNERS, TETRAHEDRON[:, ::-1])
    assert found.manifold
    assert found.volume_mm3 == pytest.approx(-1 / 6)


def test_two_pieces() -> None:
    vertices = np.concatenate([CORNERS, CORNERS + 5.0])
    faces = np.concatenate([TETRAHEDRON, TETRAHEDRON + 4])
    found = topology(vertices, faces)
    assert found.manifold
    assert (found.components, found.euler) == (2, 4)
    np.testing.assert_array_equal(face_components(faces, 8), [0] * 4 + [1] * 4)


def test_two_pieces_that_touch_in_one_vertex_are_closed_but_no_manifold() -> None:
    vertices = np.concatenate([CORNERS, -CORNERS[1:]])
    other = np.array([0, 4, 5, 6])[TETRAHEDRON][:, ::-1]
    found = topology(vertices, np.concatenate([TETRAHEDRON, other]))
    assert found.closed
    assert not found.manifold
    assert found.components == 1


def test_three_faces_at_an_edge_are_not_closed() -> None:
    vertices = np.concatenate([CORNERS, [[1.0, 1.0, 1.0]]])
    faces = np.concatenate([TETRAHEDRON, [[0, 1, 4]]])
    assert not topology(vertices, faces).closed


def test_a_degenerate_face_is_not_closed() -> None:
    assert not topology(CORNERS, np.concatenate([TETRAHEDRON, [[0, 0, 1]]])).closed


@given(
    scale=st.floats(0.1, 100.0),
    shift=st.tuples(*[st.floats(-1000.0, 1000.0)] * 3),
)
def test_volume_of_a_box(scale: float, shift: tuple[float, float, float]) -> None:
    vertices, faces = arrays(o3d.geometry.TriangleMesh.create_box(1.0, 2.0, 3.0))
    volume = signed_volume(scale * vertices + np.array(shift), faces)
    # Differences of products of three coordinates of up to a thousand: 1e9 times 1e-16 each.
    assert volume == pytest.approx(6.0 * scale**3, rel=1e-9, abs=1e-5)


def test_normals_of_a_sphere_point_outward() -> None:
    vertices, faces = arrays(o3d.geometry.TriangleMesh.create_sphere(10.0, resolution=40))
    cosine = np.sum(vertex_normals(vertices, faces) * vertices, axis=1) / 10.0
    assert cosine.min() > 0.998  # facets of 4.5 degrees


def test_normals_of_faces_are_the_cross_products_of_their_edges() -> None:
    rng = np.random.default_rng(4)
    vertices, faces = rng.normal(size=(30, 3)), rng.integers(0, 30, (80, 3))
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    np.testing.assert_array_equal(face_normals(vertices, faces), np.cross(b - a, c - a))


def test_unused_vertices_are_dropped() -> None:
    vertices = np.concatenate([[[9.0, 9.0, 9.0]], CORNERS, [[8.0, 8.0, 8.0]]])
    kept, faces, used = drop_unused_vertices(vertices, TETRAHEDRON + 1)
    np.testing.assert_array_equal(kept, CORNERS)
    np.testing.assert_array_equal(faces, TETRAHEDRON)
    np.testing.assert_array_equal(used, [1, 2, 3, 4])
    assert topology(vertices, TETRAHEDRON + 1).euler == 2
