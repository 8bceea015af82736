"""Robust non-linear least squares: Levenberg-Marquardt with iteratively reweighted groups."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
State = TypeVar("State")

CONVERGED = 1e-9  # relative decrease of the cost
TINY = 1e-12  # keeps the normal equations regular where a parameter has no influence at all


@dataclass(frozen=True, eq=False)
class Solution(Generic[State]):
    """state: the minimum.  covariance: (P, P) of the parameters, scaled by the residuals' own size.

    residuals: (N,) at the minimum.  weights: (N,) robust weights in [0, 1].
    """

    state: State
    covariance: Array
    residuals: Array
    weights: Array


def cauchy_weights(residuals: Array, group: int, scale: float) -> Array:
    """Weights (N,) of the Cauchy loss; `group` neighbouring residuals (u, v) share one weight."""
    squared = np.sum(residuals.reshape(-1, group) ** 2, axis=1) / scale**2
    return np.repeat(1.0 / (1.0 + squared), group)


def cauchy_cost(residuals: Array, group: int, scale: float) -> float:
    """Sum of the Cauchy loss over the groups."""
    squared = np.sum(residuals.reshape(-1, group) ** 2, axis=1) / scale**2
    return float(np.sum(np.log1p(squared)) * scale**2)


def spread(residuals: Array) -> float:
    """Robust standard deviation, from the median absolute value; never zero."""
    return float(max(1.4826 * np.median(np.abs(residuals)), 1e-12))


def minimize(
    start: State,
    linearize: Callable[[State], tuple[Array, Array]],
    residuals_of: Callable[[State], Array],
    retract: Callable[[State, Array], State],
    *,
    group: int = 2,
    robust: float = 4.0,
    iterations: int = 60,
) -> Solution[State]:
    """Minimise a Cauchy loss whose scale is `robust` times the residuals' own robust spread.

    linearize gives residuals (N,) and their Jacobian (N, P); retract applies a step (P,).
    Source: Madsen, Nielsen, Tingleff, Methods for Non-Linear Least Squares Problems, 2004.
    """
    state, damping = start, 1e-3
    for _ in range(iterations):
        residuals, jacobian = linearize(state)
        scale = robust * spread(residuals)
        weights = cauchy_weights(residuals, group, scale)
        normal = jacobian.T @ (jacobian * weights[:, None])
        gradient = jacobian.T @ (weights * residuals)
        cost = cauchy_cost(residuals, group, scale)
        for _ in range(12):
            damped = normal + damping * np.diag(np.diag(normal) + TINY)
            step = -np.asarray(np.linalg.solve(damped, gradient), np.float64)
            candidate = retract(state, step)
            new_cost = cauchy_cost(residuals_of(candidate), group, scale)
            if np.isfinite(new_cost) and new_cost < cost:
                break
            damping *= 8.0
        else:
            break
        state, damping = candidate, max(damping / 10.0, 1e-12)
        if cost - new_cost < CONVERGED * cost:
            break
    residuals, jacobian = linearize(state)
    weights = cauchy_weights(residuals, group, robust * spread(residuals))
    return Solution(state, covariance(jacobian, residuals, weights), residuals, weights)


def covariance(jacobian: Array, residuals: Array, weights: Array) -> Array:
    """(P, P) covariance of the parameters; the noise is taken from the weighted residuals.

    Parameters are scaled to unit diagonal before inverting, since they mix pixels and radians.
    """
    normal = jacobian.T @ (jacobian * weights[:, None])
    degrees = max(float(np.sum(weights)) - jacobian.shape[1], 1.0)
    variance = float(np.sum(weights * residuals**2)) / degrees
    size = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    inverse = np.linalg.pinv(normal / np.outer(size, size), rcond=1e-15, hermitian=True)
    return variance * inverse / np.outer(size, size)
