"""Linear Gaussian systems against dense linear algebra, in unknowns of many units."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import multivariate_normal

from bodyscan.geometry.linear_gaussian import (
    LinearGaussianSystem,
    invert_scaled,
    multiply_transposed,
    solve_scaled,
)

UNITS = 10.0 ** np.array([-6.0, -3.0, 0.0, 2.0, 4.0, 6.0])
SEEDS = st.integers(0, 2**32 - 1)


def random_matrices(count: int, seed: int = 0) -> np.ndarray:
    """(count, 6, 6), positive definite, of unknowns in `UNITS`."""
    mixed = np.random.default_rng(seed).normal(size=(count, 6, 9)) * UNITS[:, None]
    return np.asarray(mixed @ mixed.swapaxes(-1, -2))


def random_system(seed: int, count: int = 1) -> LinearGaussianSystem:
    """A stack (count, ...) of systems of unknowns in `UNITS`, or a single one."""
    vector = np.random.default_rng(seed).normal(size=(count, 6)) * UNITS
    information = random_matrices(count, seed)
    if count == 1:
        return LinearGaussianSystem(information[0], vector[0])
    return LinearGaussianSystem(information, vector)


def assert_same(found: LinearGaussianSystem, expected: LinearGaussianSystem) -> None:
    """Equal, relative to the diagonals."""
    scale = np.sqrt(np.einsum("...ii->...i", expected.information))
    outer = scale[..., :, None] * scale[..., None, :]
    np.testing.assert_allclose(found.information / outer, expected.information / outer, atol=1e-9)
    np.testing.assert_allclose(found.vector / scale, expected.vector / scale, atol=1e-9)


@given(SEEDS)
def test_observations_together_are_the_sum_of_their_systems(seed: int) -> None:
    rng = np.random.default_rng(seed)
    jacobian, observed, weights = rng.normal(size=(8, 3)), rng.normal(size=8), rng.uniform(1, 2, 8)
    system = LinearGaussianSystem.from_observations(jacobian, observed, weights)
    root = np.sqrt(weights)
    expected = np.linalg.lstsq(jacobian * root[:, None], observed * root, rcond=None)[0]
    np.testing.assert_allclose(system.solve(), expected, atol=1e-8)
    halves = [
        LinearGaussianSystem.from_observations(jacobian[s], observed[s], weights[s])
        for s in (slice(0, 5), slice(5, 8))
    ]
    assert_same(halves[0] + halves[1], system)
    assert_same(
        LinearGaussianSystem.from_observations(jacobian, observed, 3.0 * weights), system * 3.0
    )


@given(SEEDS, st.sets(st.integers(0, 5), min_size=1, max_size=5))
def test_marginalizing_keeps_mode_and_covariance_of_the_rest(seed: int, removed: set[int]) -> None:
    system = random_system(seed)
    rest = np.setdiff1d(np.arange(6), sorted(removed))
    reduced = system.marginalize(np.array(sorted(removed)))
    sigmas = np.sqrt(np.diag(system.covariance()))
    np.testing.assert_allclose(
        reduced.solve() / sigmas[rest], system.solve()[rest] / sigmas[rest], atol=1e-6
    )
    outer = np.outer(sigmas, sigmas)[np.ix_(rest, rest)]
    block = system.covariance()[np.ix_(rest, rest)]
    np.testing.assert_allclose(reduced.covariance() / outer, block / outer, atol=1e-6)


@given(SEEDS)
def test_marginalizing_in_turn_or_stacked_is_marginalizing_at_once(seed: int) -> None:
    stack = random_system(seed, count=3)
    at_once = stack.marginalize(np.array([1, 3, 4]))
    assert_same(stack.marginalize(np.array([3])).marginalize(np.array([1, 3])), at_once)
    for k in range(3):
        one = LinearGaussianSystem(stack.information[k], stack.vector[k])
        assert_same(
            one.marginalize(np.array([1, 3, 4])),
            LinearGaussianSystem(at_once.information[k], at_once.vector[k]),
        )


@given(SEEDS)
def test_projection_sums_a_stack_as_its_assembled_block_diagonal(seed: int) -> None:
    stack = random_system(seed, count=3)
    basis = np.random.default_rng(seed).normal(size=(3, 6, 4)) / UNITS[:, None]
    blocks = [
        (6 * k + np.arange(6), LinearGaussianSystem(stack.information[k], stack.vector[k]))
        for k in range(3)
    ]
    whole = LinearGaussianSystem.assemble(blocks, 18)
    assert_same(stack.project(basis), whole.project(basis.reshape(18, 4)))
    some = np.array([4, 0, 2])
    assert_same(whole.select(some), whole.project(np.eye(18)[:, some]))


@given(SEEDS, st.floats(1e-3, 1e3))
def test_evidence_is_the_ratio_of_marginal_likelihoods(seed: int, variance: float) -> None:
    rng = np.random.default_rng(seed)
    jacobian, observed = rng.normal(size=(5, 3)), rng.normal(size=5)
    system = LinearGaussianSystem.from_observations(jacobian, observed, np.ones(5))

    def log_density(covariance: np.ndarray) -> float:
        return float(multivariate_normal(np.zeros(5), covariance).logpdf(observed))

    marginal = np.eye(5) + variance * jacobian @ jacobian.T
    expected = log_density(marginal) - log_density(np.eye(5))
    assert system.log_evidence(variance) == pytest.approx(expected, abs=1e-6)
    root = rng.normal(size=(3, 3))
    expected = log_density(np.eye(5) + jacobian @ root @ root.T @ jacobian.T)
    found = system.project(root).log_evidence(np.array([1.0, variance]))
    assert found[0] + log_density(np.eye(5)) == pytest.approx(expected, abs=1e-6)
    assert found.shape == (2,)


def test_inflating_adds_a_common_error_to_the_variance_of_a_shift() -> None:
    """Eleven distances along one normal, of 0.2 mm each, with a common error of 0.5 mm."""
    jacobian = np.tile([0.6, 0.0, 0.8], (11, 1))
    system = LinearGaussianSystem.from_observations(jacobian, np.ones(11), np.full(11, 0.2**-2))
    along = system.inflate(0.5**2).project(np.array([[0.6], [0.0], [0.8]]))
    assert along.covariance()[0, 0] == pytest.approx(0.2**2 / 11 + 0.5**2)
    assert along.solve()[0] == pytest.approx(1.0)


def test_a_prior_alone_has_its_own_covariance_and_mode_zero() -> None:
    prior = LinearGaussianSystem.from_prior(np.diag([4.0, 0.25]))
    np.testing.assert_allclose(prior.covariance(), np.diag([0.25, 4.0]))
    np.testing.assert_array_equal(prior.solve(), 0.0)


def test_one_matrix_that_is_not_finite_spoils_no_other() -> None:
    good = np.diag([1e-12, 1.0, 1e12])
    bad = np.full((3, 3), np.nan)
    singular = np.diag([4.0, 0.0, 2.0])
    found = invert_scaled(np.stack([good, bad, singular]))
    np.testing.assert_allclose(found[0], np.diag([1e12, 1.0, 1e-12]))
    assert np.isnan(found[1]).all()
    np.testing.assert_allclose(found[2], np.diag([0.25, 0.0, 0.5]), atol=1e-12)
    matrices = np.stack([np.ones((3, 3)), bad])
    solution = solve_scaled(matrices, np.array([[3.0, 3.0, 3.0], [1.0, 1.0, 1.0]]))
    np.testing.assert_allclose(solution[0], [1.0, 1.0, 1.0])
    assert np.isnan(solution[1]).all()


def test_inverses_are_accurate_and_exactly_symmetric_whatever_the_units() -> None:
    many = random_matrices(20)
    for matrices in (many, many[0]):
        found = invert_scaled(matrices)
        np.testing.assert_array_equal(found, found.swapaxes(-1, -2))
        # Condition numbers of some hundreds.
        ones = matrices @ found * UNITS / UNITS[:, None]
        np.testing.assert_allclose(ones, np.broadcast_to(np.eye(6), ones.shape), atol=1e-11)


@pytest.mark.parametrize("damping", [0.0, 0.3])
def test_damping_is_relative_to_each_diagonal_element(damping: float) -> None:
    matrices, right = random_matrices(20), np.random.default_rng(1).normal(size=(20, 6)) * UNITS
    damped = matrices * (1.0 + damping * np.eye(6))
    found = solve_scaled(matrices, right, np.full(20, damping))
    np.testing.assert_allclose(
        (damped @ found[..., None])[..., 0] / UNITS, right / UNITS, atol=1e-10
    )
    np.testing.assert_allclose(solve_scaled(matrices[3], right[3], damping), found[3])


@pytest.mark.parametrize("share", [1e-12, 2e-15, 1e-16])
def test_a_weakly_observed_direction_is_known_until_rounding_hides_it(share: float) -> None:
    """Two unknowns whose sum is observed, and their difference with that share of the weight."""
    matrix = np.array([[1.0, 1.0], [1.0, 1.0]]) + share * np.array([[1.0, -1.0], [-1.0, 1.0]])
    variance = np.array([1.0, -1.0]) @ invert_scaled(matrix) @ [1.0, -1.0]
    # Double precision holds the share to 1e-4.
    assert variance == pytest.approx(1.0 / share if share > 1e-14 else 0.0, rel=1e-3, abs=1e-3)


@pytest.mark.parametrize("rows", [0, 5, 127, 128, 129, 391])
def test_products_in_blocks_are_the_product_of_the_whole(rows: int) -> None:
    left, right = np.random.default_rng(2).normal(size=(2, rows, 4))
    np.testing.assert_allclose(
        multiply_transposed(left, right[:, :3]),
        np.einsum("ni,nj->ij", left, right[:, :3]),
        atol=1e-12,
    )
