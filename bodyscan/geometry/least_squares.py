"""Non-linear least squares, damped and robust: the solver under every fit in the package.

`minimize` solves one problem with unknowns of any kind, its residuals in blocks that each involve a
few columns. `minimize_each` solves many small problems of one kind at once (the corners of a board,
points to triangulate) with stacked normal equations.

Both use the same stopping rule. Costs are in units of a residual's variance; a problem has settled
when the last step lowered its cost, or the next one can lower it, by less than `tolerance` variances.
Then no combination of unknowns is farther off than about sqrt(`tolerance`) of its own sigma.

Source: Madsen, Nielsen, Tingleff, Methods for Non-Linear Least Squares Problems, 2004; robust
weights: Triggs et al., Bundle Adjustment - A Modern Synthesis, 2000, section 3.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Generic, Literal, TypeVar

import numpy as np

from bodyscan.arrays import Array, Indices, Mask
from bodyscan.compiled import compiled
from bodyscan.geometry.linear_gaussian import invert_scaled, multiply_transposed, solve_scaled
from bodyscan.geometry.robust import (
    compute_cauchy_cost,
    compute_cauchy_weights,
    estimate_robust_scale,
)

Columns = Indices | slice
State = TypeVar("State")

FACTOR = 10.0
"""A step that lowers the cost divides the damping by this; one that does not multiplies it."""
MIN_DAMPING, EFFECTIVE_DAMPING = 1e-12, 1e-4
"""Shares of the scaled diagonal: below the first, rounding dominates; below the second, damping has
no effect, so a refused step raises it there at once."""

Ending = Literal["settled", "out of steps", "stuck"]
OUT_OF_STEPS: Ending = "out of steps"


@dataclass(frozen=True)
class Noise:
    """The error model of one kind of residual; blocks with equal `Noise` share one spread."""

    kind: str
    group: int = 1  # how many neighbouring residuals (u and v of a corner) share one weight
    # Scales beyond which residuals count less and less (Cauchy loss); None: all count alike.
    cauchy: float | None = None
    min_scale: float = 1e-12  # lower limit of the scale
    known: float | None = None  # the spread, where it need not be estimated

    def estimate_scale(self, residuals: Array) -> float:
        return (
            estimate_robust_scale(residuals, self.min_scale) if self.known is None else self.known
        )

    def cost(self, residuals: Array) -> float:
        """Cost of residuals (N,) given in units of their spread."""
        if self.cauchy is None:
            return float(residuals @ residuals)
        return compute_cauchy_cost(residuals, self.group, self.cauchy)

    def weights(self, residuals: Array) -> Array:
        """Weights (N,) in [0, 1] of residuals (N,) given in units of their spread."""
        if self.cauchy is None:
            return np.ones(len(residuals))
        return compute_cauchy_weights(residuals, self.group, self.cauchy)

    def mean_square(self, residuals: Array) -> float:
        """Mean square of robustly weighted residuals (N,), in their unit squared."""
        weights = self.weights(residuals / self.estimate_scale(residuals))
        return float(weights @ residuals**2 / np.sum(weights))


EXACT = Noise("in standard deviations", known=1.0)
"""For priors, and for everything already expressed in its own standard deviations."""


@dataclass(frozen=True, eq=False)
class Block:
    """Residuals (N,) that depend only on the unknowns `columns` (C,).

    linearize: returns the Jacobian (N, C); called once, and never for a step that is refused.
    sigma: of each residual (N,), or of all; held fixed while steps from here are tried.
    runs: (G,) lengths of runs of residuals, each with its own row of `columns` (G, C), such as the
        boards of one camera, each with its pose: one block each would cost more in calls than sums.

    A prior is a block too: its residuals are in standard deviations (`EXACT`).
    """

    residuals: Array
    linearize: Callable[[], Array]
    columns: Columns
    noise: Noise
    sigma: Array | float = 1.0
    runs: Indices | None = None

    @cached_property
    def jacobian(self) -> Array:
        return self.linearize()


@dataclass(frozen=True, eq=False)
class Solution(Generic[State]):
    """The minimum and what is needed for its covariance."""

    state: State  # the minimum
    blocks: tuple[Block, ...]  # evaluated there
    weights: tuple[Array, ...]  # robust weights (N,) in [0, 1] of each block
    scales: tuple[float, ...]  # of each block, in its residuals' sigmas
    unknowns: int  # P
    steps: int  # how many were taken
    # `settled` (see above); `out of steps`; or `stuck`: no step lowers the cost although the
    # equations predict one (a wrong Jacobian, a kink).
    ending: Ending

    @cached_property
    def covariance(self) -> Array:
        """Covariance (P, P) of the unknowns, with the residuals' spread as their noise."""
        parts = zip(self.blocks, self.weights, self.scales, strict=True)
        return invert_scaled(_form_equations(parts, self.unknowns)[0])

    @cached_property
    def covariance_by_freedoms(self) -> Array:
        """`covariance`, the spread of each kind of residuals taken over its own degrees of freedom.

        Unknowns fit part of the noise, so that residuals are smaller than it: by a quarter for three
        boards of 48 corners whose print is unknown.
        """
        scales = list(self.scales)
        for noise, numbers in _group_by_noise(self.blocks).items():
            if noise.known is None:
                parts = [(self.blocks[k], self.weights[k], self.scales[k]) for k in numbers]
                spent = float(np.sum(_form_equations(parts, self.unknowns)[0] * self.covariance))
                total = sum(float(np.sum(weights)) for _, weights, _ in parts)
                for k in numbers:
                    scales[k] *= np.sqrt(total / max(total - spent, 1.0))
        parts = list(zip(self.blocks, self.weights, scales, strict=True))
        return invert_scaled(_form_equations(parts, self.unknowns)[0])

    @property
    def variance(self) -> float:
        """Weighted mean square residual per degree of freedom, in squared scales: the factor for a
        covariance based on the residuals' own size instead of their spread."""
        squares, total = 0.0, 0.0
        for block, weights, size in zip(self.blocks, self.weights, self.scales, strict=True):
            squares += float(weights @ (block.residuals / (block.sigma * size)) ** 2)
            total += float(np.sum(weights))
        return squares / max(total - self.unknowns, 1.0)


def minimize(
    start: State,
    blocks_at: Callable[[State], Iterable[Block]],
    retract: Callable[[State, Array], State],
    *,
    unknowns: int,
    steps: int = 60,
    tolerance: float = 1e-6,
    damping: float = 1e-3,
) -> Solution[State]:
    """Levenberg-Marquardt; each step uses robust weights from the residuals before it.

    blocks_at: returns the same blocks in the same order at any state; residuals that are not finite
        reject the state.
    retract: applies a step (P,) to a state.
    damping: of the first step, as a share of a unit diagonal.
    """
    state, blocks = start, tuple(blocks_at(start))
    taken, ending = 0, OUT_OF_STEPS
    weights, scales = _weigh(blocks)
    while taken < steps:
        cost = _compute_cost(blocks, blocks, scales)
        parts = zip(blocks, weights, scales, strict=True)
        normal, gradient = _form_equations(parts, unknowns)
        promised = 0.0
        # After ten increases of the damping nothing moves any more.
        for attempt in range(10):
            step = -solve_scaled(normal, gradient, damping)
            promised = promised if attempt else -float(step @ gradient)
            candidate = retract(state, step)
            tried = tuple(blocks_at(candidate))
            gained = cost - _compute_cost(tried, blocks, scales)
            if gained > 0.0 or promised < tolerance:
                break
            damping = max(FACTOR * damping, EFFECTIVE_DAMPING)
        if not gained > 0.0:
            ending = "settled" if promised < tolerance else "stuck"
            break
        state, blocks, taken = candidate, tried, taken + 1
        damping = max(damping / FACTOR, MIN_DAMPING)
        weights, scales = _weigh(blocks)
        if gained < tolerance:
            ending = "settled"
            break
    return Solution(state, blocks, weights, scales, unknowns, taken, ending)


@dataclass(frozen=True, eq=False)
class StackedEquations:
    """Normal equations of N small problems."""

    normal: Array  # (N, P, P), J^T W J
    gradient: Array  # (N, P), J^T W r
    cost: Array  # (N,), r^T W r
    freedoms: Array  # (N,), sum of the weights less the number of unknowns, at least 1

    def where(self, chosen: Mask, others: StackedEquations) -> StackedEquations:
        """Take the `chosen` (N,) problems from here and the rest from `others`."""
        return StackedEquations(
            np.where(chosen[:, None, None], self.normal, others.normal),
            np.where(chosen[:, None], self.gradient, others.gradient),
            np.where(chosen, self.cost, others.cost),
            np.where(chosen, self.freedoms, others.freedoms),
        )

    @property
    def variance(self) -> Array:
        """Variance (N,) of a residual, estimated from the cost that remains."""
        return np.asarray(self.cost / self.freedoms, np.float64)


@dataclass(frozen=True, eq=False)
class StackedSolution:
    """The minima of N problems."""

    state: Array  # (N, P)
    equations: StackedEquations  # evaluated there
    converged: Mask  # (N,), which problems settled

    def covariance(self) -> Array:
        """Covariance (N, P, P), with each problem's noise estimated from its remaining cost."""
        return invert_scaled(self.equations.normal) * self.equations.variance[:, None, None]


def minimize_each(
    start: Array,
    equations_at: Callable[[Array], StackedEquations],
    *,
    steps: int,
    within: Callable[[Array], Array] = lambda state: state,
    tolerance: float = 1e-6,
    damping: float = 1e-3,
    min_sigma: float = 1e-12,
) -> StackedSolution:
    """Levenberg-Marquardt on N problems (N, P) of a few unknowns, each with its own damping.

    within: brings a state back into its allowed range.
    min_sigma: lower limit of a residual's standard deviation, so that residuals of nearly 0 settle too.
    """
    state, at = start, equations_at(start)
    strength, converged = np.full(len(start), damping), np.zeros(len(start), bool)
    for _ in range(steps):
        step = -solve_scaled(at.normal, at.gradient, strength)
        enough = tolerance * np.maximum(at.variance, min_sigma**2)
        promised = -np.sum(step * at.gradient, axis=1)
        trial = within(state + step)
        tried = equations_at(trial)
        gained = at.cost - tried.cost
        better = gained > 0.0
        # A small predicted gain that is due to damping is no sign of convergence.
        converged |= (promised < enough) & (strength <= EFFECTIVE_DAMPING)
        converged |= better & (gained < enough)
        state = np.where(better[:, None], trial, state)
        at = tried.where(better, at)
        eased = np.maximum(strength / FACTOR, MIN_DAMPING)
        strength = np.where(better, eased, np.maximum(FACTOR * strength, EFFECTIVE_DAMPING))
        if converged.all():
            break
    return StackedSolution(state, at, converged)


def _weigh(blocks: Sequence[Block]) -> tuple[tuple[Array, ...], tuple[float, ...]]:
    """Robust weights and spread of each block; all residuals of a kind share one spread."""
    weights: list[Array] = [np.empty(0)] * len(blocks)
    scales = [0.0] * len(blocks)
    for noise, numbers in _group_by_noise(blocks).items():
        scaled = _normalize_residuals(blocks, blocks, numbers)
        size = noise.estimate_scale(scaled)
        cuts = np.cumsum([len(blocks[k].residuals) for k in numbers])[:-1]
        parts = np.split(noise.weights(scaled / size), cuts)
        for k, part in zip(numbers, parts, strict=True):
            weights[k], scales[k] = part, size
    return tuple(weights), tuple(scales)


def _compute_cost(
    blocks: Sequence[Block], there: Sequence[Block], scales: Sequence[float]
) -> float:
    """Total cost of blocks, with sigmas and scales as they were `there`."""
    total = 0.0
    with np.errstate(all="ignore"):
        for noise, numbers in _group_by_noise(blocks).items():
            total += noise.cost(_normalize_residuals(blocks, there, numbers) / scales[numbers[0]])
    return total


def _group_by_noise(blocks: Sequence[Block]) -> dict[Noise, list[int]]:
    kinds: dict[Noise, list[int]] = {}
    for number, block in enumerate(blocks):
        kinds.setdefault(block.noise, []).append(number)
    return kinds


def _normalize_residuals(
    blocks: Sequence[Block], there: Sequence[Block], numbers: Sequence[int]
) -> Array:
    return np.concatenate([blocks[k].residuals / there[k].sigma for k in numbers])


def _form_equations(
    parts: Iterable[tuple[Block, Array, float]], unknowns: int
) -> tuple[Array, Array]:
    """Normal matrix (P, P) and gradient (P,) of half the cost of blocks with weights and scales."""
    normal, gradient = np.zeros((unknowns, unknowns)), np.zeros(unknowns)
    for block, weight, size in parts:
        if not len(block.residuals):
            continue
        weighted = block.jacobian * (weight / (block.sigma * size) ** 2)[:, None]
        if block.runs is not None:
            assert not isinstance(block.columns, slice)
            rows = np.ascontiguousarray(block.jacobian), weighted, block.residuals
            _add_runs(rows, block.runs, block.columns, normal, gradient)
            continue
        by = block.columns
        square = (by, by) if isinstance(by, slice) else np.ix_(by, by)
        normal[square] += multiply_transposed(weighted, block.jacobian)
        gradient[by] += weighted.T @ block.residuals
    return normal, gradient


@compiled
def _add_runs(
    rows: tuple[Array, Array, Array],
    runs: Indices,
    columns: Indices,
    normal: Array,
    gradient: Array,
) -> None:
    """Add a block of several runs to the equations; rows: Jacobian, weighted Jacobian, residuals."""
    (jacobian, weighted, residuals), first, size = rows, 0, columns.shape[1]
    square = np.zeros((size, size))
    for run in range(len(runs)):
        by = columns[run]
        for n in range(first, first + runs[run]):
            for i in range(size):
                gradient[by[i]] += weighted[n, i] * residuals[n]
                for j in range(i + 1):
                    square[i, j] += weighted[n, i] * jacobian[n, j]
        first += runs[run]
        for i in range(size):
            for j in range(size):
                normal[by[i], by[j]] += square[max(i, j), min(i, j)]
        square[:] = 0.0
