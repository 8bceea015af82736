"""Surface nets: closed, manifold and outward whatever the values are."""

from __future__ import annotations

import numpy as np
import pytest

from bodyscan.mesh.surface_nets import SIDE, Bricks, extract_surface, join_bricks, split_into_bricks
from bodyscan.mesh.topology import compute_topology

SHAPE = (3, 2, 4)


def grid(kept: np.ndarray | None = None) -> Bricks:
    wanted = np.ones(SHAPE, bool) if kept is None else kept
    return Bricks.from_mask(wanted, np.array([10.0, -20.0, 5.0]), 2.0)


def nodes(bricks: Bricks) -> np.ndarray:
    """(a, b, c, 3) mm of all nodes of the grid."""
    index = np.moveaxis(np.indices([SIDE * size for size in SHAPE]), 0, -1)
    return bricks.origin + bricks.cell_mm * index


def test_a_ball_is_round_and_outward() -> None:
    bricks = grid()
    centre, radius = bricks.origin + [23.0, 15.3, 31.1], 12.2
    values = np.linalg.norm(nodes(bricks) - centre, axis=-1) - radius
    vertices, faces = extract_surface(bricks, split_into_bricks(values.astype(np.float32)))
    found = compute_topology(vertices, faces)
    assert (found.manifold, found.components, found.euler) == (True, 1, 2)
    # Means of crossings lie inside a curved surface by up to cell^2 / (4 radius), 0.08 mm.
    error = np.linalg.norm(vertices - centre, axis=1) - radius
    assert -0.12 < error.min() < error.max() < 0.04
    assert found.volume_mm3 == pytest.approx(4 / 3 * np.pi * radius**3, rel=0.03)


@pytest.mark.parametrize("seed", range(5))
def test_noise_gives_closed_manifold_surfaces(seed: int) -> None:
    """Every case of a cell and of its neighbours, ambiguous faces and all."""
    rng = np.random.default_rng(seed)
    values = np.ones([SIDE * size for size in SHAPE], np.float32)
    values[1:-1, 1:-1, 1:-1] = rng.normal(size=[SIDE * size - 2 for size in SHAPE])
    bricks = grid()
    vertices, faces = extract_surface(bricks, split_into_bricks(values))
    assert len(faces) > 3000
    found = compute_topology(vertices, faces)
    assert found.closed
    assert found.manifold
    np.testing.assert_array_equal(np.unique(faces), np.arange(len(vertices)))


def test_bricks_away_from_the_surface_are_not_needed() -> None:
    whole = grid()
    values = np.linalg.norm(nodes(whole) - whole.origin - [15.0, 15.0, 25.0], axis=-1) - 10.0
    dense = split_into_bricks(values.astype(np.float32))
    near = np.abs(dense).reshape(len(dense), -1).min(axis=1) < 4.0
    kept = near.reshape(SHAPE)
    assert 4 < near.sum() < near.size
    all_of_it, sparse = extract_surface(whole, dense), extract_surface(grid(kept), dense[near])
    np.testing.assert_array_equal(all_of_it[0], sparse[0])
    np.testing.assert_array_equal(all_of_it[1], sparse[1])


def test_surfaces_closer_than_a_cell_stay_apart() -> None:
    """Two balls that a single node parts: one vertex for both sheets would make them touch."""
    bricks = grid()
    centres = bricks.origin + [[14.0, 14.0, 14.0], [14.0, 14.0, 34.0]]
    to_each = np.linalg.norm(nodes(bricks)[..., None, :] - centres, axis=-1) - 9.1
    vertices, faces = extract_surface(
        bricks, split_into_bricks(to_each.min(axis=-1).astype(np.float32))
    )
    found = compute_topology(vertices, faces)
    assert found.manifold
    assert found.components == 2


def test_bricks_and_dense_values_are_the_same() -> None:
    dense = np.random.default_rng(0).normal(size=[SIDE * n for n in SHAPE]).astype(np.float32)
    np.testing.assert_array_equal(join_bricks(split_into_bricks(dense), SHAPE), dense)
