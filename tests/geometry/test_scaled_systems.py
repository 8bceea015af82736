"""Normal equations of unknowns in many units, regular, singular and not finite."""

from __future__ import annotations

import numpy as np
import pytest

from bodyscan.geometry.scaled_systems import BLOCK, gram, invert_scaled, solve_scaled


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


UNITS = 10.0 ** np.array([-6.0, -3.0, 0.0, 2.0, 4.0, 6.0])


def some_matrices(count: int) -> np.ndarray:
    """(count, 6, 6), positive definite, of unknowns in `UNITS`."""
    mixed = np.random.default_rng(0).normal(size=(count, 6, 9)) * UNITS[:, None]
    return np.asarray(mixed @ mixed.swapaxes(-1, -2))


def test_inverses_are_inverses_and_covariances_to_the_last_digit_whatever_the_units() -> None:
    """One matrix or many: what is taken for a covariance is symmetric exactly."""
    many = some_matrices(20)
    for matrices in (many, many[0]):
        found = invert_scaled(matrices)
        np.testing.assert_array_equal(found, found.swapaxes(-1, -2))
        # Condition numbers of some hundreds.
        ones = matrices @ found * UNITS / UNITS[:, None]
        np.testing.assert_allclose(ones, np.broadcast_to(np.eye(6), ones.shape), atol=1e-11)


@pytest.mark.parametrize("damping", [0.0, 0.3])
def test_damping_is_a_share_of_each_unknown_s_own_diagonal(damping: float) -> None:
    matrices, right = some_matrices(20), np.random.default_rng(1).normal(size=(20, 6)) * UNITS
    damped = matrices * (1.0 + damping * np.eye(6))
    found = solve_scaled(matrices, right, np.full(20, damping))
    np.testing.assert_allclose(
        (damped @ found[..., None])[..., 0] / UNITS, right / UNITS, atol=1e-10
    )
    np.testing.assert_allclose(solve_scaled(matrices[3], right[3], damping), found[3])


@pytest.mark.parametrize("share", [1e-12, 2e-15, 1e-16])
def test_what_is_hardly_seen_is_told_and_what_rounding_leaves_is_open(share: float) -> None:
    """Two unknowns of which the sum is measured, and the difference with so small a share of it."""
    matrix = np.array([[1.0, 1.0], [1.0, 1.0]]) + share * np.array([[1.0, -1.0], [-1.0, 1.0]])
    variance = np.array([1.0, -1.0]) @ invert_scaled(matrix) @ [1.0, -1.0]
    # The double holds the share to 1e-4.
    assert variance == pytest.approx(1.0 / share if share > 1e-14 else 0.0, rel=1e-3, abs=1e-3)


@pytest.mark.parametrize("rows", [0, 5, BLOCK - 1, BLOCK, BLOCK + 1, 3 * BLOCK + 7])
def test_blocks_of_tall_matrices_make_the_product_of_the_whole(rows: int) -> None:
    left, right = np.random.default_rng(2).normal(size=(2, rows, 4))
    np.testing.assert_allclose(
        gram(left, right[:, :3]), np.einsum("ni,nj->ij", left, right[:, :3]), atol=1e-12
    )
