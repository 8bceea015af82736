"""Whether a richer model predicts held-out boards better than a simpler one, beyond chance.

With residuals r of the richer model and r + d of the simpler one, squares differ by d^2 + 2 r d:
the first term is the difference of the models, the second is due to noise, and its standard error
shows in its sums over independent parts. Lenses, models of the light, bent boards and joint solves
are all chosen by differences at the same points, never by a ratio of noisy totals.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bodyscan.arrays import Array, Indices
from bodyscan.geometry.robust import cauchy_weights, robust_scale

CLEARLY = 3.0
"""Standard errors by which a richer model must be better: by chance once in 700 times."""
CAUCHY_SIGMAS = 4.0


@dataclass(frozen=True, eq=False)
class Compared:
    """Residuals (N, D) of the same points in two models, simple and rich.

    part: (N,) number of a part whose errors are independent of other parts'; points that err
        together, such as the corners of one board, share a part.
    """

    simple: Array
    rich: Array
    part: Indices


def shared_weights(tried: Sequence[Array]) -> Array:
    """Weights (N,) of points with residuals (N, D) in each model: low where no model fits."""
    size = tried[0].shape[1]
    least = np.min([np.sum(residuals**2, axis=1) for residuals in tried], axis=0)
    sigma = min(robust_scale(residuals.ravel()) for residuals in tried)
    each = np.repeat(np.sqrt(least / size), size) / sigma
    return np.asarray(cauchy_weights(each, size, CAUCHY_SIGMAS)[::size], np.float64)


def gain(*compared: Compared) -> float:
    """Standard errors by which the richer model lowers the squares of held-out residuals.

    Each kind of points is scaled by its own robust sigma.
    """
    gained, squares = 0.0, 0.0
    for one in compared:
        per_square = shared_weights([one.simple, one.rich]) / _least_spread(one) ** 2
        gained += float(np.sum(per_square * np.sum(one.simple**2 - one.rich**2, axis=1)))
        crossed = per_square * np.sum(2.0 * one.rich * (one.simple - one.rich), axis=1)
        squares += float(np.sum(np.bincount(one.part, crossed) ** 2))
    return gained / max(float(np.sqrt(squares)), 1e-12)


def _least_spread(one: Compared) -> float:
    return min(robust_scale(residuals.ravel()) for residuals in (one.simple, one.rich))
