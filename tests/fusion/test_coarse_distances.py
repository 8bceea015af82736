"""The coarse grid that leaves no node out: where it lies, and what it says between its nodes."""

from __future__ import annotations

import numpy as np
import pytest

from bodyscan.arrays import Array
from bodyscan.fusion.hole_filling import _grid_around, _mirror
from bodyscan.fusion.signed_distances import (
    Distances,
    find_crossed_bricks,
    interpolate_distances,
)
from bodyscan.mesh.surface_nets import SIDE, Bricks

CELL_MM, FINE_MM = 7.0, 3.0
ORIGIN = np.array([-40.0, 15.0, -3.5])
SHAPE = (20, 17, 23)


def nodes(shape: tuple[int, ...], cell_mm: float) -> Array:
    return np.asarray(ORIGIN + cell_mm * np.moveaxis(np.indices(shape), 0, -1))


def distances(values: Array) -> Distances:
    return Distances(values.astype(np.float32), ORIGIN, CELL_MM)


def fine(shape: tuple[int, int, int]) -> Bricks:
    return Bricks.from_mask(np.ones(shape, bool), ORIGIN, FINE_MM)


def test_between_nodes_it_is_linear_and_beyond_the_grid_as_at_its_rim() -> None:
    def field(places: Array) -> Array:
        x, y, z = np.moveaxis(places, -1, 0)
        return np.asarray(0.3 * x - 0.2 * y + 0.1 * z + 4.0)

    bricks = fine((6, 5, 7))
    found = interpolate_distances(distances(field(nodes(SHAPE, CELL_MM))), bricks)
    index = SIDE * bricks.indices[:, None, None, None] + np.moveaxis(np.indices((SIDE,) * 3), 0, -1)
    last = ORIGIN + CELL_MM * (np.array(SHAPE) - 1.0)
    truth = field(np.minimum(ORIGIN + FINE_MM * index, last))
    assert (ORIGIN + FINE_MM * index > last).any()
    np.testing.assert_allclose(found, truth, atol=1e-4)


def test_a_twist_is_told_between_eight_nodes() -> None:
    def field(places: Array) -> Array:
        x, y, z = np.moveaxis((places - ORIGIN) / CELL_MM, -1, 0)
        return np.asarray(x * y * z - 2.0 * x * z)

    found = interpolate_distances(distances(field(nodes(SHAPE, CELL_MM))), fine((5, 4, 6)))
    index = np.stack(np.unravel_index(np.arange(120), (5, 4, 6)), axis=-1)
    index = SIDE * index[:, None, None, None] + np.moveaxis(np.indices((SIDE,) * 3), 0, -1)
    inside = (FINE_MM * index <= CELL_MM * (np.array(SHAPE) - 1.0)).all(axis=-1)
    np.testing.assert_allclose(
        found[inside], field(ORIGIN + FINE_MM * index)[inside], rtol=1e-4, atol=1e-2
    )


def test_the_surface_passes_through_the_bricks_that_it_does_and_some_beside() -> None:
    """Of a ball; a brick with the cells around it, and as far as coarse nodes say more."""
    shape = (6, 5, 7)
    centre = ORIGIN + [62.0, 55.0, 70.0]

    def ball(places: Array) -> Array:
        return np.asarray(np.linalg.norm(places - centre, axis=-1) - 33.0)

    found = find_crossed_bricks(distances(ball(nodes(SHAPE, CELL_MM))), FINE_MM, shape)
    inside = np.zeros(shape, bool)
    clear = np.zeros(shape, bool)
    for brick in np.ndindex(shape):
        steps = np.arange(-1, SIDE + 1)
        places = np.stack(
            np.meshgrid(*(FINE_MM * (SIDE * k + steps) for k in brick), indexing="ij"), axis=-1
        )
        values = ball(ORIGIN + places)
        inside[brick] = values.min() < 0.0 <= values.max()
        clear[brick] = np.abs(values).min() > 2.0 * CELL_MM * np.sqrt(3.0)
    assert found[inside].all()
    assert not found[clear].any()
    assert inside.sum() > 20
    assert clear.sum() > 20


def test_below_the_floor_is_what_is_above_where_nothing_was_measured() -> None:
    values = np.arange(10.0)[None, None].repeat(2, axis=0).astype(np.float32)
    where = np.ones(values.shape, bool)
    where[1, 0, 2] = False
    _mirror(values, 4, where)
    assert values[0, 0].tolist() == [7, 6, 5, 4, 4, 5, 6, 7, 8, 9]
    assert values[1, 0].tolist() == [7, 6, 2, 4, 4, 5, 6, 7, 8, 9]
    few = np.arange(5.0, dtype=np.float32)[None, None]
    _mirror(few, 3, np.ones(few.shape, bool))  # two above it only
    assert few[0, 0].tolist() == [0, 4, 3, 3, 4]
    whole = np.arange(4.0, dtype=np.float32)[None, None]
    _mirror(whole, 0, np.ones(whole.shape, bool))
    assert whole[0, 0].tolist() == [0, 1, 2, 3]


@pytest.mark.parametrize(("cell_mm", "room_mm"), [(7.0, 60.0), (20.0, 100.0)])
def test_the_grid_has_room_around_the_points_and_the_floor_between_two_layers(
    cell_mm: float, room_mm: float
) -> None:
    points = np.array([[-120.0, -80.0, 2.0], [130.0, 95.0, 800.0]])
    bricks = _grid_around(points, cell_mm)
    layer = -bricks.origin[2] / cell_mm
    assert layer % 1.0 == pytest.approx(0.5)
    last = bricks.origin + cell_mm * (SIDE * np.array(bricks.table.shape) - 1)
    assert np.all(points[0] - bricks.origin >= room_mm)
    assert np.all(points[0] - bricks.origin < room_mm + 2.0 * cell_mm)
    assert np.all(last - points[1] >= room_mm - 1e-9)
    assert np.all(last - points[1] < room_mm + (SIDE + 1) * cell_mm)
