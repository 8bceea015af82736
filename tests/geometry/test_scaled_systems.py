"""Normal equations of unknowns in many units, regular, singular and not finite."""

from __future__ import annotations

import numpy as np

from bodyscan.geometry.scaled_systems import invert_scaled, solve_scaled


def test_one_matrix_that_is_not_finite_spoils_no_other() -> None:
    good = np.diag([1e-12, 1.0, 1e12])
    bad = np.full((3, 3), np.nan)
    singular = np.diag([4.0, 0.0, 2.0])
    found = invert_scaled(np.stack([good, bad, singular]))
    np.testing.assert_allclose(found[0], np.diag([1e12, 1.0, 1e-12]))
    assert np.isnan(found[1]).all()
    np.testing.assert_allclose(found[2], np.diag([0.25, 0.0, 0.5]), atol=1e-12)


def test_a_singular_system_beside_one_that_is_not_finite_is_solved() -> None:
    matrices = np.stack([np.ones((3, 3)), np.full((3, 3), np.nan)])
    found = solve_scaled(matrices, np.array([[3.0, 3.0, 3.0], [1.0, 1.0, 1.0]]))
    np.testing.assert_allclose(found[0], [1.0, 1.0, 1.0])
    assert np.isnan(found[1]).all()
