"""Twins and fans on small surfaces."""

from __future__ import annotations

import numpy as np
import open3d as o3d
from hypothesis import given
from hypothesis import strategies as st

from bodyscan.mesh.half_edges import RIM, UNSOUND, corner_fans, twins

TORUS = np.asarray(o3d.geometry.TriangleMesh.create_torus(30.0, 10.0, 12, 8).triangles)
FACES = TORUS.astype(np.int64)
COUNT = int(FACES.max()) + 1


def ends(faces: np.ndarray) -> np.ndarray:
    """(3 F, 2) start and end of each half-edge."""
    return np.stack([faces.ravel(), np.roll(faces, -1, axis=1).ravel()], axis=-1)


@given(seed=st.integers(0, 1000), missing=st.integers(0, 60))
def test_twins_run_the_other_way(seed: int, missing: int) -> None:
    gone = np.random.default_rng(seed).choice(len(FACES), missing, replace=False)
    faces = np.delete(FACES, gone, axis=0)
    twin, edges = twins(faces, COUNT).ravel(), ends(faces)
    known = {(int(a), int(b)): number for number, (a, b) in enumerate(edges)}
    expected = [known.get((int(b), int(a)), RIM) for a, b in edges]
    np.testing.assert_array_equal(twin, expected)


def test_edges_of_three_faces_are_unsound() -> None:
    faces = np.concatenate([FACES, [[FACES[0, 0], FACES[0, 1], COUNT]]])
    twin = twins(faces, COUNT + 1)
    assert twin[0, 0] == UNSOUND
    assert twin[-1, 0] == UNSOUND
    # Its two sides in the torus and the fin.
    assert np.count_nonzero(twin == UNSOUND) == 3


def test_an_edge_without_length_is_unsound() -> None:
    twin = twins(np.array([[0, 0, 1]]), 2)
    assert twin[0, 0] == UNSOUND


def test_every_vertex_of_a_closed_surface_has_one_fan() -> None:
    labels, count = corner_fans(twins(FACES, COUNT))
    assert count == COUNT
    pairs = np.unique(np.stack([labels.ravel(), FACES.ravel()], axis=-1), axis=0)
    assert len(pairs) == COUNT


def test_a_vertex_with_two_rims_has_two_fans() -> None:
    """Four of the six faces about a vertex, in two pairs that only the vertex joins."""
    around = np.flatnonzero((FACES == 20).any(axis=1))
    assert len(around) == 6
    spokes = {}  # from the vertex after 20 to the face
    for face in around:
        corner = int(np.flatnonzero(FACES[face] == 20)[0])
        spokes[int(FACES[face, (corner + 1) % 3])] = face
    first = around[0]
    order = [first]
    while len(order) < 6:
        corner = int(np.flatnonzero(FACES[order[-1]] == 20)[0])
        order.append(spokes[int(FACES[order[-1], (corner + 2) % 3])])
    faces = FACES[[order[0], order[1], order[3], order[4]]]
    labels, _ = corner_fans(twins(faces, COUNT))
    own = labels[faces == 20]
    assert own[0] == own[1] != own[2] == own[3]


def test_no_faces_have_no_fans() -> None:
    labels, count = corner_fans(twins(np.empty((0, 3), np.int64), 0))
    assert labels.shape == (0, 3)
    assert count == 0
