"""What the overlap of two pairs says of a cell, and how much of it is believed."""

from __future__ import annotations

import numpy as np

from bodyscan.alignment.matching import Matches
from bodyscan.geometry.linear_gaussian import LinearGaussianSystem
from bodyscan.motion.cell_equations import CellEquations


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
