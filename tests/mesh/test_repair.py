"""Damaged surfaces become closed manifold ones; sound ones stay."""

from __future__ import annotations

import numpy as np
import open3d as o3d
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_bodies import arrays, together

from bodyscan.mesh.repair import close_mesh, largest_piece
from bodyscan.mesh.topology import topology

SPHERE = o3d.geometry.TriangleMesh.create_sphere(100.0, 12)
VERTICES = np.asarray(SPHERE.vertices)
FACES = np.asarray(SPHERE.triangles).astype(np.int64)
VOLUME = topology(VERTICES, FACES).volume_mm3


def test_a_sound_surface_stays_as_it_is() -> None:
    vertices, faces = close_mesh(VERTICES, FACES)
    assert len(vertices) == len(VERTICES)
    assert len(faces) == len(FACES)
    np.testing.assert_array_equal(vertices[faces], VERTICES[FACES])


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000), share=st.floats(0.0, 0.4))
def test_holes_are_closed(seed: int, share: float) -> None:
    kept = np.random.default_rng(seed).random(len(FACES)) >= share
    vertices, faces = close_mesh(VERTICES, FACES[kept])
    found = topology(vertices, faces)
    assert found.manifold
    assert found.volume_mm3 > 0


def test_a_hole_of_one_face_costs_next_to_no_volume() -> None:
    found = topology(*close_mesh(VERTICES, FACES[1:]))
    assert found.euler == 2
    assert found.components == 1
    assert found.volume_mm3 == pytest.approx(VOLUME, rel=1e-6)


def test_a_fin_on_an_edge_goes() -> None:
    vertices = np.concatenate([VERTICES, [[0.0, 0.0, 200.0]]])
    fin = [FACES[50, 0], FACES[50, 1], len(VERTICES)]
    assert not topology(vertices, np.concatenate([FACES, [fin]])).closed
    found = topology(*close_mesh(vertices, np.concatenate([FACES, [fin]])))
    assert found.manifold
    assert found.euler == 2
    # The two faces at the edge go with the fin, and a flat patch takes their place.
    assert found.volume_mm3 == pytest.approx(VOLUME, rel=0.01)


@pytest.mark.parametrize("turned", [False, True])
def test_a_doubled_face_goes(turned: bool) -> None:
    again = FACES[30:31, ::-1] if turned else FACES[30:31]
    found = topology(*close_mesh(VERTICES, np.concatenate([FACES, again])))
    assert found.manifold
    assert found.volume_mm3 == pytest.approx(VOLUME, rel=0.01)


def test_surfaces_that_touch_in_a_vertex_are_parted() -> None:
    other = np.where(FACES == 0, 0, FACES + len(VERTICES))
    top = VERTICES[0]
    vertices = np.concatenate([VERTICES, 2.0 * top - VERTICES])
    faces = np.concatenate([FACES, other[:, ::-1]])
    before = topology(vertices, faces)
    assert before.closed
    assert not before.manifold
    found = topology(*close_mesh(vertices, faces))
    assert found.manifold
    assert (found.components, found.euler) == (2, 4)


def test_a_face_with_a_repeated_corner_goes() -> None:
    found = topology(*close_mesh(VERTICES, np.concatenate([FACES, [[5, 5, 6]]])))
    assert found.manifold


def test_of_several_pieces_the_one_that_was_measured_most_is_kept() -> None:
    """A wall's back, filled, may have more faces than what stands before it."""
    make = o3d.geometry.TriangleMesh.create_sphere
    small, large = arrays(make(40.0, 8)), arrays(make(100.0, 24).translate([500.0, 0.0, 0.0]))
    vertices, faces = together(small, large)
    assert len(largest_piece(vertices, faces)[1]) == len(large[1])
    points = np.concatenate([np.repeat(1.01 * small[0], 50, axis=0), large[0]])
    kept, _ = largest_piece(vertices, faces, points)
    np.testing.assert_allclose(np.linalg.norm(kept, axis=1).max(), 40.0)
