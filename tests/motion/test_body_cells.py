"""Cells: distances through two slabs beside a narrow gap, and what the overlap of two pairs says."""

from __future__ import annotations

import numpy as np
import pytest
from normal_field import normal_field

from bodyscan.alignment.matching import Matches
from bodyscan.arrays import Array
from bodyscan.geometry.linear_gaussian import LinearGaussianSystem
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.motion.body_cells import (
    BodyCells,
    build_rigid_fields,
    evaluate_field,
    express_in_camera,
    modulate_fields,
)
from bodyscan.motion.cell_equations import CellEquations


def sides(low: Array, high: Array) -> tuple[Array, Array]:
    """Points every 5 mm on the four upright sides and the top of a box, and outward normals."""
    points, normals = [], []
    for axis, end in ((0, 0), (0, 1), (1, 0), (1, 1), (2, 1)):
        others = [k for k in range(3) if k != axis]
        grid = np.meshgrid(*(np.arange(low[k] + 2.5, high[k], 5.0) for k in others))
        face = np.empty((grid[0].size, 3))
        face[:, others] = np.stack([g.ravel() for g in grid], axis=1)
        face[:, axis] = (low, high)[end][axis]
        points.append(face)
        normals.append(np.tile((2.0 * end - 1.0) * np.eye(3)[axis], (len(face), 1)))
    return np.concatenate(points), np.concatenate(normals)


@pytest.fixture(scope="module")
def slabs() -> BodyCells:
    """An arm 80 mm thick, 40 mm beside a trunk of 200, joined by a shoulder above both."""
    parts = [
        sides(np.array([0.0, -100.0, 0.0]), np.array([120.0, 100.0, 600.0])),
        sides(np.array([0.0, 140.0, 0.0]), np.array([120.0, 220.0, 600.0])),
        sides(np.array([0.0, -100.0, 605.0]), np.array([120.0, 220.0, 700.0])),
    ]
    points = np.concatenate([part[0] for part in parts])
    return BodyCells.from_points(points, np.concatenate([part[1] for part in parts]))[0]


def cell_at(cells: BodyCells, *place: float) -> int:
    return int(np.argmin(np.linalg.norm(cells.centres - place, axis=1)))


def test_it_is_far_across_a_gap_and_near_through_a_limb(slabs: BodyCells) -> None:
    inner, outer = cell_at(slabs, 60.0, 140.0, 100.0), cell_at(slabs, 60.0, 220.0, 100.0)
    beside = cell_at(slabs, 60.0, 100.0, 100.0)
    away = slabs.distances(np.array([inner]))[0]
    assert away[outer] < 130.0  # 80 straight through
    assert away[beside] > 800.0  # up to the shoulder and down again; 40 across


def test_a_forearm_that_touches_the_belly_is_far_from_it() -> None:
    """Neither by the corner between them, nor through what it hides of the belly."""
    belly, belly_normals = sides(np.array([0.0, -150.0, 0.0]), np.array([120.0, 150.0, 600.0]))
    arm, arm_normals = sides(np.array([120.0, -40.0, 0.0]), np.array([200.0, 40.0, 600.0]))
    shoulder = sides(np.array([0.0, -150.0, 605.0]), np.array([200.0, 150.0, 700.0]))
    seen = (belly[:, 0] < 120.0) | (np.abs(belly[:, 1]) > 40.0)
    free = arm[:, 0] > 120.0
    points = np.concatenate([belly[seen], arm[free], shoulder[0]])
    normals = np.concatenate([belly_normals[seen], arm_normals[free], shoulder[1]])
    cells = BodyCells.from_points(points, normals)[0]
    away = cells.distances(np.array([cell_at(cells, 200.0, 0.0, 100.0)]))[0]
    for beside in ((120.0, 80.0, 100.0), (0.0, 0.0, 100.0)):
        assert away[cell_at(cells, *beside)] > 800.0  # over the shoulder


def test_what_is_near_moves_alike(slabs: BodyCells) -> None:
    alike = slabs.covariance_factor(150.0, 1e-4)
    inner, beside = cell_at(slabs, 60.0, 140.0, 100.0), cell_at(slabs, 60.0, 100.0, 100.0)
    above = cell_at(slabs, 60.0, 140.0, 200.0)
    products = alike @ alike[inner]
    assert products[inner] == pytest.approx(1.0, abs=0.1)
    assert products[above] == pytest.approx(np.exp(-0.5 * (100.0 / 150.0) ** 2), abs=0.15)
    assert abs(products[beside]) < 0.05


def test_slopes_are_those_of_a_function_along_the_surface(slabs: BodyCells) -> None:
    slopes = slabs.gradients(slabs.centres @ np.array([[0.0], [0.02], [0.03]]))[..., 0]
    side = np.abs(slabs.normals[:, 0]) > 0.99
    inside = side & (np.abs(slabs.centres[:, 2] - 300.0) < 200.0)
    np.testing.assert_allclose(slopes[inside, 1:].mean(axis=0), [0.02, 0.03], rtol=0.05)
    assert np.abs(slopes[inside, 0]).max() < 0.004


def test_a_turn_carries_points_as_a_turn_does(slabs: BodyCells) -> None:
    centre = np.array([10.0, 20.0, 300.0])
    field = build_rigid_fields(slabs, centre, 400.0) @ np.array([0.4, -0.3, 0.2, 1.0, 2.0, 3.0])
    points = slabs.centres + np.random.default_rng(1).uniform(-15.0, 15.0, slabs.centres.shape)
    expected = np.cross([0.001, -0.00075, 0.0005], points - centre) + [1.0, 2.0, 3.0]
    np.testing.assert_allclose(evaluate_field(field, points - slabs.centres), expected, atol=1e-9)
    # And in a camera's frame.
    place = RigidTransform.from_rotation_vector([0.3, -0.5, 0.9], [100.0, 200.0, 900.0])
    back = place.inverse()
    off = back.apply(points) - back.apply(slabs.centres)
    np.testing.assert_allclose(
        place.rotate(evaluate_field(express_in_camera(field, place), off)), expected, atol=1e-9
    )


def test_a_field_times_a_function_changes_as_both_do(slabs: BodyCells) -> None:
    rising = slabs.centres[:, 2:] * 0.01
    found = modulate_fields(normal_field(slabs), slabs, rising)[..., 0]
    np.testing.assert_allclose(found[:, :3], rising * slabs.normals)
    side = (np.abs(slabs.normals[:, 0]) > 0.99) & (np.abs(slabs.centres[:, 2] - 300.0) < 200.0)
    by_z = found.reshape(-1, 4, 3)[side, 3]
    np.testing.assert_allclose(
        by_z.mean(axis=0), 0.01 * slabs.normals[side].mean(axis=0), atol=1e-3
    )


def test_every_point_is_found_in_its_cell(slabs: BodyCells) -> None:
    near = slabs.centres + 2.0 * slabs.normals
    np.testing.assert_array_equal(slabs.find(near, slabs.normals), np.arange(len(near)))
    many = slabs.find_by_groups(near, slabs.normals)
    assert np.linalg.norm(slabs.centres[many] - near, axis=1).max() < 40.0


def test_no_number_of_matches_makes_calibrations_straight() -> None:
    """Few matches count as they are; of very many a cell's shift is known to what it is doubted by, and
    where it lies is the same."""
    along = np.zeros((2, 12, 12))
    along[:, 0, 0] = 1.0, 1e6  # to 1 mm, and to a thousandth
    seen = CellEquations(np.array([3, 7]), LinearGaussianSystem(along, along[:, 0] * 0.5))
    doubted = seen.with_model_error(0.07)
    np.testing.assert_allclose(
        doubted.system.information[:, 0, 0] ** -0.5, np.hypot([1.0, 1e-3], 0.07)
    )
    np.testing.assert_allclose(
        doubted.system.vector[:, 0], 0.5 * doubted.system.information[:, 0, 0]
    )


def test_the_evidence_of_a_cell_is_that_of_its_matches_by_its_displacement_field() -> None:
    """Distances change by what the field moves their points along the normals; beyond two of their own
    spread they count for less, and so many of them as one."""
    rng = np.random.default_rng(6)
    centres, cell = np.array([[0.0, 0.0, 1000.0], [40.0, -10.0, 990.0]]), np.repeat([1, 0], 60)
    off, normals = rng.uniform(-25.0, 25.0, (120, 3)), rng.standard_normal((120, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    distances, sigma_mm = rng.normal(0.0, 0.5, 120), rng.uniform(0.1, 0.3, 120)
    matches = Matches(centres[cell] + off, normals, distances, sigma_mm, np.arange(120))
    found = CellEquations.from_matches(matches, cell, centres, correlated=5.0)
    # A field is the centre's displacement, then how it changes along x, y and z.
    along = np.concatenate([np.ones((120, 1)), off], axis=1)
    jacobian = (along[:, :, None] * normals[:, None]).reshape(120, 12)
    sigma = np.hypot(sigma_mm, 1.4826 * np.median(np.abs(distances)))
    weights = 1.0 / (1.0 + (distances / (2.0 * sigma)) ** 2) / (sigma**2 * 5.0)
    for k in range(2):
        own, weight = jacobian[cell == k], weights[cell == k]
        np.testing.assert_allclose(
            found.system.information[k], own.T @ (weight[:, None] * own), atol=1e-6
        )
        np.testing.assert_allclose(
            -found.system.vector[k], own.T @ (weight * distances[cell == k]), atol=1e-6
        )
    assert found.cells.tolist() == [0, 1]


def test_cells_that_no_match_lies_in_say_nothing() -> None:
    points = np.array([[0.0, 0.0, 5.0], [90.0, 0.0, -5.0]])
    ones = np.ones(2)
    matches = Matches(points, np.tile([0.0, 0.0, 1.0], (2, 1)), ones, ones, np.arange(2))
    centres = np.array([[0.0, 0, 0], [40.0, 0, 0], [90.0, 0, 0], [130.0, 0, 0]])
    found = CellEquations.from_matches(matches, np.array([0, 2]), centres, correlated=1.0)
    assert found.cells.tolist() == [0, 2]
    assert found.system.information.shape == (2, 12, 12)
    assert (found.system.information[:, 2, 2] > 0.0).all()
