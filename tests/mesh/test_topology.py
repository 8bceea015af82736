"""Half-edges, topology, normals and handles of small surfaces that are known."""

from __future__ import annotations

import numpy as np
import open3d as o3d
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_bodies import arrays

from bodyscan.arrays import Indices
from bodyscan.mesh.topology import (
    RIM,
    UNSOUND,
    compute_face_normals,
    compute_signed_volume,
    compute_topology,
    compute_vertex_normals,
    drop_unused_vertices,
    find_twins,
    label_components,
    label_corner_fans,
)

make = o3d.geometry.TriangleMesh
TORUS = np.asarray(make.create_torus(30.0, 10.0, 12, 8).triangles).astype(np.int64)
COUNT = int(TORUS.max()) + 1
CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
TETRAHEDRON = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
APEX = np.array([0, 4, 5, 6])


@given(seed=st.integers(0, 1000), missing=st.integers(0, 60))
def test_twins_run_in_the_opposite_direction(seed: int, missing: int) -> None:
    removed = np.random.default_rng(seed).choice(len(TORUS), missing, replace=False)
    faces = np.delete(TORUS, removed, axis=0)
    edges = np.stack([faces.ravel(), np.roll(faces, -1, axis=1).ravel()], axis=-1)
    known = {(int(a), int(b)): number for number, (a, b) in enumerate(edges)}
    expected = [known.get((int(b), int(a)), RIM) for a, b in edges]
    np.testing.assert_array_equal(find_twins(faces, COUNT).ravel(), expected)


def test_edges_of_three_faces_and_edges_without_length_are_unsound() -> None:
    twin = find_twins(np.concatenate([TORUS, [[TORUS[0, 0], TORUS[0, 1], COUNT]]]), COUNT + 1)
    assert twin[0, 0] == twin[-1, 0] == UNSOUND
    assert np.count_nonzero(twin == UNSOUND) == 3  # both half-edges in the torus, and the fin's
    assert find_twins(np.array([[0, 0, 1]]), 2)[0, 0] == UNSOUND


def test_every_vertex_of_a_closed_surface_has_one_fan() -> None:
    labels, count = label_corner_fans(find_twins(TORUS, COUNT))
    assert count == COUNT
    assert len(np.unique(np.stack([labels.ravel(), TORUS.ravel()]), axis=1).T) == COUNT
    labels, count = label_corner_fans(find_twins(np.empty((0, 3), np.int64), 0))
    assert (labels.shape, count) == ((0, 3), 0)


def test_a_vertex_with_two_rims_has_two_fans() -> None:
    """Four of six faces around vertex 0, in two pairs that have only the vertex in common."""
    faces = np.array([[0, k, k % 6 + 1] for k in (1, 2, 4, 5)])
    labels, count = label_corner_fans(find_twins(faces, 7))
    assert labels[0, 0] == labels[1, 0] != labels[2, 0] == labels[3, 0]
    assert count == 2 + 6


TWO = (np.concatenate([CORNERS, CORNERS + 5.0]), np.concatenate([TETRAHEDRON, TETRAHEDRON + 4]))
TOUCHING = np.concatenate([CORNERS, -CORNERS[1:]])


@pytest.mark.parametrize(
    ("vertices", "faces", "closed", "manifold", "components", "euler"),
    [
        (CORNERS, TETRAHEDRON, True, True, 1, 2),
        (CORNERS, TETRAHEDRON[:, ::-1], True, True, 1, 2),
        (*arrays(make.create_torus(30.0, 10.0)), True, True, 1, 0),
        (*TWO, True, True, 2, 4),
        (TOUCHING, np.concatenate([TETRAHEDRON, APEX[TETRAHEDRON][:, ::-1]]), True, False, 1, 3),
        *((CORNERS, np.delete(TETRAHEDRON, k, axis=0), False, False, 1, 1) for k in range(4)),
        (np.vstack([CORNERS, [1, 1, 1]]), np.vstack([TETRAHEDRON, [0, 1, 4]]), False, False, 1, 2),
        (CORNERS, np.vstack([TETRAHEDRON, [0, 0, 1]]), False, False, 1, 2),
        (CORNERS, np.vstack([TETRAHEDRON[:3], TETRAHEDRON[3:, ::-1]]), False, False, 1, 2),
    ],
)
def test_topology_of_known_surfaces(
    vertices: np.ndarray, faces: Indices, closed: bool, manifold: bool, components: int, euler: int
) -> None:
    found = compute_topology(vertices, faces)
    assert (found.closed, found.manifold, found.components) == (closed, manifold, components)
    if faces.shape[0] == 4 or closed:
        assert found.euler == euler


def test_components_are_numbered_and_unused_vertices_dropped() -> None:
    np.testing.assert_array_equal(label_components(TWO[1], 8), [0] * 4 + [1] * 4)
    vertices = np.concatenate([[[9.0, 9.0, 9.0]], CORNERS, [[8.0, 8.0, 8.0]]])
    kept, faces, used = drop_unused_vertices(vertices, TETRAHEDRON + 1)
    np.testing.assert_array_equal(kept, CORNERS)
    np.testing.assert_array_equal(faces, TETRAHEDRON)
    np.testing.assert_array_equal(used, [1, 2, 3, 4])
    assert compute_topology(vertices, TETRAHEDRON + 1).euler == 2


@given(scale=st.floats(0.1, 100.0), shift=st.tuples(*[st.floats(-1000.0, 1000.0)] * 3))
def test_volume_of_a_box(scale: float, shift: tuple[float, float, float]) -> None:
    vertices, faces = arrays(make.create_box(1.0, 2.0, 3.0))
    volume = compute_signed_volume(scale * vertices + np.array(shift), faces)
    # Differences of products of three coordinates of up to a thousand: 1e9 times 1e-16 each.
    assert volume == pytest.approx(6.0 * scale**3, rel=1e-9, abs=1e-5)
    assert compute_signed_volume(vertices, faces[:, ::-1]) == pytest.approx(-6.0)


def test_normals() -> None:
    vertices, faces = arrays(make.create_sphere(10.0, resolution=40))
    cosine = np.sum(compute_vertex_normals(vertices, faces) * vertices, axis=1) / 10.0
    assert cosine.min() > 0.998  # facets of 4.5 degrees
    rng = np.random.default_rng(4)
    vertices, faces = rng.normal(size=(30, 3)), rng.integers(0, 30, (80, 3))
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    np.testing.assert_array_equal(compute_face_normals(vertices, faces), np.cross(b - a, c - a))
