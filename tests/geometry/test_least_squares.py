"""The one solver, by itself: minima and covariances that are known, and what it says of its work."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import pytest

from bodyscan.arrays import Array, Mask
from bodyscan.geometry.least_squares import (
    EXACT,
    Block,
    Noise,
    Solution,
    StackedEquations,
    minimize,
    minimize_each,
)
from bodyscan.geometry.robust import (
    compute_cauchy_cost,
    compute_cauchy_weights,
    estimate_robust_scale,
)

TIME = np.linspace(0.0, 3.0, 60)
TRUE = np.array([2.0, 0.7, -0.5])
PLAIN = Noise("measured")
ROBUST = Noise("measured", cauchy=3.0)


def decay(state: Array) -> Array:
    """a exp(-b t) + c."""
    with np.errstate(over="ignore"):
        return state[0] * np.exp(-state[1] * TIME) + state[2]


def decay_jacobian(state: Array) -> Array:
    fall = np.exp(-state[1] * TIME)
    return np.column_stack([fall, -state[0] * TIME * fall, np.ones_like(TIME)])


def add(state: Array, step: Array) -> Array:
    return state + step


def fit(
    measured: Array,
    start: Array | list[float],
    noise: Noise = PLAIN,
    jacobian: Callable[[Array], Array] = decay_jacobian,
    **options: Any,
) -> Solution[Array]:
    def blocks(state: Array) -> list[Block]:
        return [Block(decay(state) - measured, lambda: jacobian(state), slice(0, 3), noise)]

    return minimize(np.asarray(start, float), blocks, add, unknowns=3, **options)


def noisy(seed: int, sigma: float = 0.01) -> Array:
    return decay(TRUE) + np.random.default_rng(seed).normal(0.0, sigma, len(TIME))


def test_the_minimum_of_exact_data_is_the_truth() -> None:
    solution = fit(decay(TRUE), [1.0, 1.5, 0.0])
    assert np.allclose(solution.state, TRUE, atol=1e-9)
    assert solution.ending == "settled"


def test_rosenbrocks_valley_is_followed_to_its_end() -> None:
    def blocks(state: Array) -> list[Block]:
        x, y = state
        residuals = np.array([10.0 * (y - x * x), 1.0 - x])
        jacobian = np.array([[-20.0 * x, 10.0], [-1.0, 0.0]])
        return [Block(residuals, lambda: jacobian, slice(0, 2), EXACT)]

    solution = minimize(np.array([-1.2, 1.0]), blocks, add, unknowns=2)
    assert np.allclose(solution.state, 1.0, atol=1e-6)


def test_a_start_from_which_undamped_steps_run_away_is_recovered() -> None:
    """arctan: Newton's steps from |x| > 1.39 grow without limit."""

    def blocks(state: Array) -> list[Block]:
        slope = 1.0 / (1.0 + state**2)
        return [Block(np.arctan(state), lambda: slope[:, None], slice(0, 1), EXACT)]

    solution = minimize(np.array([30.0]), blocks, add, unknowns=1, damping=1e-9)
    assert abs(solution.state[0]) < 1e-3
    assert solution.ending == "settled"


def test_states_without_finite_residuals_are_stepped_back_from() -> None:
    """log x, minimum at x = 1: an undamped step from 5 goes to a negative x."""

    def blocks(state: Array) -> list[Block]:
        with np.errstate(invalid="ignore"):
            value = np.log(state)
        return [Block(value, lambda: 1.0 / state[:, None], slice(0, 1), EXACT)]

    solution = minimize(np.array([5.0]), blocks, add, unknowns=1, damping=1e-9)
    assert solution.state[0] == pytest.approx(1.0, abs=1e-3)


def test_the_covariance_is_what_many_repetitions_scatter_by() -> None:
    fits = [fit(noisy(seed), TRUE) for seed in range(400)]
    scatter = np.cov(np.stack([one.state for one in fits]).T)
    said = np.stack([one.variance * one.covariance for one in fits]).mean(axis=0)
    # 400 draws know a standard deviation to 3.5 %.
    assert np.allclose(np.sqrt(np.diag(said)), np.sqrt(np.diag(scatter)), rtol=0.12)
    assert said[0, 2] / np.sqrt(said[0, 0] * said[2, 2]) == pytest.approx(
        np.asarray(np.corrcoef(np.stack([one.state for one in fits]).T))[0, 2], abs=0.1
    )


def test_outliers_lose_their_weight_and_do_not_move_the_fit() -> None:
    measured = noisy(1)
    measured[::10] += 1.0
    plain, robust = fit(measured, TRUE), fit(measured, TRUE, ROBUST)
    sigmas = np.sqrt(np.diag(robust.variance * robust.covariance))
    assert np.all(np.abs(robust.state - TRUE) < 4.0 * sigmas)
    assert np.abs(plain.state - TRUE).max() > 5.0 * np.abs(robust.state - TRUE).max()
    (weights,) = robust.weights
    assert weights[::10].max() < 0.01
    assert np.median(weights) > 0.8


def test_kinds_of_residuals_are_each_weighed_by_their_own_spread() -> None:
    """One coarse and one fine instrument for one number: the mean goes by the fine one."""
    rng = np.random.default_rng(4)
    coarse, fine = 5.0 + rng.normal(0, 1.0, 200), 5.0 + rng.normal(0, 0.01, 200)

    def blocks(state: Array) -> list[Block]:
        ones = np.ones((200, 1))
        return [
            Block(state - coarse, lambda: ones, slice(0, 1), Noise("coarse", cauchy=4.0)),
            Block(state - fine, lambda: ones, slice(0, 1), Noise("fine", cauchy=4.0)),
        ]

    solution = minimize(np.zeros(1), blocks, add, unknowns=1)
    assert solution.scales == pytest.approx([1.0, 0.01], rel=0.2)
    assert abs(solution.state[0] - 5.0) < 0.003
    assert np.sqrt(solution.covariance[0, 0]) == pytest.approx(0.01 / np.sqrt(200), rel=0.3)


def test_a_prior_holds_what_the_data_leave_open() -> None:
    """Two unknowns of which only the sum is measured."""

    def blocks(state: Array) -> list[Block]:
        return [
            Block(state.sum() - np.array([3.0]), lambda: np.ones((1, 2)), slice(0, 2), EXACT, 0.01),
            Block((state - [1.0, 1.0]) / 0.5, lambda: np.eye(2) / 0.5, slice(0, 2), EXACT),
        ]

    solution = minimize(np.zeros(2), blocks, add, unknowns=2)
    assert np.allclose(solution.state, 1.5, atol=1e-3)
    along, across = np.array([1.0, 1.0]), np.array([1.0, -1.0])
    assert along @ solution.covariance @ along == pytest.approx(0.01**2, rel=0.01)
    assert across @ solution.covariance @ across == pytest.approx(2 * 0.5**2, rel=0.01)


def test_blocks_that_touch_few_columns_give_what_one_dense_block_gives() -> None:
    rng = np.random.default_rng(0)
    shared, own = rng.normal(size=(4, 20, 2)), rng.normal(size=(4, 20, 3))
    measured = rng.normal(size=(4, 20))
    columns = [np.array([0, 1, 2 + 3 * k, 3 + 3 * k, 4 + 3 * k]) for k in range(4)]
    jacobians = [np.concatenate([a, b], axis=1) for a, b in zip(shared, own, strict=True)]
    dense = np.zeros((80, 14))
    for k, jacobian in enumerate(jacobians):
        dense[20 * k : 20 * k + 20, columns[k]] = jacobian

    def sparse(state: Array) -> Iterator[Block]:
        for k, jacobian in enumerate(jacobians):
            residuals = jacobian @ state[columns[k]] - measured[k]
            yield Block(residuals, partial(np.asarray, jacobian), columns[k], ROBUST)

    def whole(state: Array) -> list[Block]:
        return [Block(dense @ state - measured.ravel(), lambda: dense, slice(0, 14), ROBUST)]

    by_blocks, at_once = (minimize(np.zeros(14), f, add, unknowns=14) for f in (sparse, whole))
    assert np.allclose(by_blocks.state, at_once.state, atol=1e-12)
    assert np.allclose(by_blocks.covariance, at_once.covariance, atol=1e-12)


def test_one_block_of_runs_gives_what_a_block_for_each_run_gives() -> None:
    rng = np.random.default_rng(1)
    lengths = np.array([20, 8, 14])
    columns = np.array([[0, 1, 2 + 3 * k, 3 + 3 * k, 4 + 3 * k] for k in range(3)])
    jacobian, measured = rng.normal(size=(42, 5)), rng.normal(size=42)
    runs = np.split(np.arange(42), np.cumsum(lengths)[:-1])

    def residuals(state: Array) -> list[Array]:
        return [jacobian[r] @ state[c] - measured[r] for r, c in zip(runs, columns, strict=True)]

    def apart(state: Array) -> Iterator[Block]:
        for left, own, rows in zip(residuals(state), columns, runs, strict=True):
            yield Block(left, partial(np.asarray, jacobian[rows]), own, ROBUST)

    def together(state: Array) -> list[Block]:
        left = np.concatenate(residuals(state))
        return [Block(left, lambda: jacobian, columns, ROBUST, runs=lengths)]

    many, one = (minimize(np.zeros(11), f, add, unknowns=11) for f in (apart, together))
    assert np.allclose(many.state, one.state, atol=1e-12)
    assert np.allclose(many.covariance, one.covariance, atol=1e-12)


def test_a_fit_cut_short_says_so() -> None:
    solution = fit(noisy(2), [0.5, 3.0, 1.0], steps=2)
    assert (solution.ending, solution.steps) == ("out of steps", 2)


def test_a_wrong_jacobian_is_reported_as_stuck() -> None:
    backwards = fit(noisy(3), [1.0, 1.5, 0.0], jacobian=lambda state: -decay_jacobian(state))
    assert backwards.ending == "stuck"


def test_steps_that_are_refused_ask_for_no_jacobian() -> None:
    asked = []

    def jacobian(state: Array) -> Array:
        asked.append(state)
        return decay_jacobian(state)

    solution = fit(noisy(5), [0.1, 8.0, 3.0], jacobian=jacobian, damping=1e-12)
    assert len(asked) <= solution.steps + 1


@dataclass(frozen=True)
class Many:
    """Decays of different length and noise, some points missing."""

    measured: np.ndarray
    weights: np.ndarray

    def equations(self, states: Array) -> StackedEquations:
        residuals = np.stack([decay(state) for state in states]) - self.measured
        jacobians = np.stack([decay_jacobian(state) for state in states])
        weighted = np.swapaxes(jacobians * self.weights[..., None], 1, 2)
        return StackedEquations(
            weighted @ jacobians,
            (weighted @ residuals[..., None])[..., 0],
            np.sum(self.weights * residuals**2, axis=1),
            np.sum(self.weights, axis=1) - 3.0,
        )


def many() -> Many:
    rng = np.random.default_rng(6)
    measured = np.stack([noisy(seed, 0.003 * (1 + seed)) for seed in range(5)])
    return Many(measured, (rng.random(measured.shape) < 0.8).astype(float))


def test_many_problems_at_once_come_out_as_one_by_one() -> None:
    problems, start = many(), np.tile([1.0, 1.5, 0.0], (5, 1))
    together = minimize_each(start, problems.equations, steps=40)
    assert together.converged.all()
    for k in range(5):
        alone = replace(problems, measured=problems.measured[[k]], weights=problems.weights[[k]])
        single = minimize_each(start[:1], alone.equations, steps=40)
        assert np.allclose(together.state[k], single.state[0], atol=1e-6)
        seen = problems.weights[k] > 0.0

        def blocks(state: Array, k: int = k, seen: Mask = seen) -> Iterator[Block]:
            residuals = (decay(state) - problems.measured[k])[seen]
            yield Block(residuals, lambda: decay_jacobian(state)[seen], slice(0, 3), PLAIN)

        whole = minimize(start[k], blocks, add, unknowns=3, tolerance=1e-9)
        assert np.allclose(together.state[k], whole.state, atol=1e-5)
        assert np.allclose(together.covariance()[k], whole.variance * whole.covariance, rtol=1e-3)


def test_of_many_problems_those_cut_short_are_named() -> None:
    problems = many()
    start = np.tile(TRUE, (5, 1))
    start[3] = [1.0, 2.0, 0.5]
    solution = minimize_each(start, problems.equations, steps=3)
    assert solution.converged.tolist() == [True, True, True, False, True]


def test_the_spread_is_a_standard_deviation_that_outliers_do_not_sway() -> None:
    values = np.random.default_rng(9).normal(0.0, 2.0, 20000)
    assert estimate_robust_scale(values) == pytest.approx(2.0, rel=0.02)
    values[:2000] = 1e6
    assert estimate_robust_scale(values) < 2.5
    assert estimate_robust_scale(np.zeros(5), 0.1) == 0.1


@pytest.mark.parametrize("group", [1, 2])
def test_cauchy_weights_are_the_slope_of_the_cost(group: int) -> None:
    residuals = np.random.default_rng(10).normal(0.0, 5.0, 12)
    slope = [
        (
            compute_cauchy_cost(residuals + h, group, 3.0)
            - compute_cauchy_cost(residuals - h, group, 3.0)
        )
        / 2e-4
        for h in 1e-4 * np.eye(12)
    ]
    # Central differences over 1e-4 of a curve that bends over 3: 1e-9 of its size.
    assert np.allclose(
        slope, 2.0 * compute_cauchy_weights(residuals, group, 3.0) * residuals, atol=1e-6
    )
    assert compute_cauchy_cost(1e-3 * residuals, group, 3.0) == pytest.approx(
        1e-6 * residuals @ residuals, 1e-4
    )
