"""Which model of the light a pair needs, found from boards that the model was not fitted to."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from bodyscan.arrays import Array, Indices, Mask
from bodyscan.calibration.boundary_points import BoundaryPoints, board_errors, select
from bodyscan.geometry.light_planes import LightSheets
from bodyscan.geometry.robust import SIGMAS_PER_MEDIAN, spread

MOST_FOLDS = 6
AS_GOOD = 1.15
"""A simpler kind of model is taken if its error is at most this many times the best one's: boards
held out differ by as much among themselves."""
CAP = 30.0
"""No point counts for more than this many times the best model's median."""
OUTLIER = 4.0 * SIGMAS_PER_MEDIAN
LEAST_SHARE = 0.01
"""Boards are never taken for known so well that less than this share of the squared held-out
distances is theirs."""


@dataclass(frozen=True)
class Candidate:
    """A model to try; candidates are listed simplest first, those of a kind together.

    fit: sheets from points, with the covariance of boards 1 mm out of place.
    everywhere: gives sheets for every s, so that a ray it cannot measure counts against it.
    """

    name: str
    kind: str
    fit: Callable[[BoundaryPoints], LightSheets]
    everywhere: bool = True


@dataclass(frozen=True)
class HeldOutModel:
    """How well one model measured boards that it was not fitted to, mm from the board.

    mean_mm: of the absolute distances, outliers capped, board by board: what the choice is made by.
    median_mm: of all absolute distances.  rms_mm: without outliers.  measured: share of the points
    that got a depth.  chosen: whether this model is used.
    """

    model: str
    mean_mm: float
    median_mm: float
    rms_mm: float
    measured: float
    chosen: bool = False


@dataclass(frozen=True, eq=False)
class HeldOutErrors:
    """distances: (N,) mm of the measured points from their boards, NaN where not measured.

    unit_variance: (N,) mm^2, what they would be if boards were known to 1 mm (see `BoardErrors`).
    """

    distances: Array
    unit_variance: Array

    def board_error_mm(self, data: BoundaryPoints) -> float:
        """How far out of place boards must be, for distances as large as these are.

        data: the points that were held out. Their own noise, seen in how neighbours on a boundary
        differ, is taken off.
        """
        known = np.isfinite(self.distances) & np.isfinite(self.unit_variance)
        squared = self.distances[known] ** 2
        if not squared.size:
            return 0.0
        limit = OUTLIER**2 * np.median(squared)
        total = np.minimum(squared, limit).mean()
        together = (np.diff(data.index) == 0) & (np.diff(data.board) == 0)
        steps = np.diff(self.distances)[together]
        steps = steps[np.isfinite(steps)]
        noise = 0.5 * spread(steps) ** 2 if steps.size else 0.0
        left = max(total - noise, LEAST_SHARE * total)
        return float(np.sqrt(left / self.unit_variance[known].mean()))


def folds(data: BoundaryPoints) -> Indices:
    """(N,) number of the group in which each point is held out: its board, or one of MOST_FOLDS
    groups of boards; with only two boards, a half of one."""
    boards, number = np.unique(data.board, return_inverse=True)
    if len(boards) > 2:
        return number % MOST_FOLDS
    half = board_errors(data).effects[:, 2] > 0.0
    return 2 * number + half


def hold_out(candidate: Candidate, data: BoundaryPoints, fold: Indices) -> HeldOutErrors:
    """Fit without each fold in turn, and measure what was left out."""
    distances, variance = np.full((2, len(fold)), np.nan)
    errors = board_errors(data)
    own = np.sum(errors.effects**2, axis=1)
    for number in np.unique(fold):
        left_out = fold == number
        sheets = candidate.fit(select(data, ~left_out))
        points, s = data.points[left_out], data.index[left_out].astype(float)
        rays, facing = points / points[:, 2:], errors.facing[left_out]
        depth = sheets.depth(rays, s)
        distances[left_out] = (depth - points[:, 2]) * facing
        sheets_own = sheets.variance_mm2(rays, s, depth) * facing**2
        variance[left_out] = own[left_out] + sheets_own
    return HeldOutErrors(distances, variance)


def select_model(
    candidates: Sequence[Candidate], tried: Sequence[HeldOutErrors], board: Indices
) -> tuple[int, tuple[HeldOutModel, ...]]:
    """The number of the model to use, and the figures of all that measured anything.

    Of the models that measure everywhere the best of the simplest kind that is as good as the best
    of all. The others, which give no depth where a stripe was seen too seldom, are compared with it
    only where they do, and must be clearly better.
    """
    distances = [np.abs(errors.distances) for errors in tried]
    medians = [_median(d) for d in distances]
    cap = CAP * min(medians)
    everywhere = [i for i, c in enumerate(candidates) if c.everywhere]
    capped = [np.minimum(np.nan_to_num(d, nan=cap), cap) for d in distances]
    means = [_mean_of_boards(c, board, np.ones(len(c), bool)) for c in capped]
    best = min(means[i] for i in everywhere)
    kind = next(candidates[i].kind for i in everywhere if means[i] <= AS_GOOD * best)
    chosen = min((i for i in everywhere if candidates[i].kind == kind), key=means.__getitem__)
    for i in sorted(set(range(len(candidates))) - set(everywhere)):
        known = np.isfinite(distances[i])
        means[i] = _mean_of_boards(capped[i], board, known)
        if AS_GOOD * means[i] < _mean_of_boards(capped[chosen], board, known):
            chosen = i
    figures = tuple(
        HeldOutModel(
            candidate.name,
            means[i],
            medians[i],
            _rms(distances[i]),
            float(np.isfinite(distances[i]).mean()),
            i == chosen,
        )
        for i, candidate in enumerate(candidates)
        if np.isfinite(medians[i])
    )
    return chosen, figures


def _mean_of_boards(values: Array, board: Indices, known: Mask) -> float:
    """Every board counts the same, however many points it has."""
    count, total = np.bincount(board[known]), np.bincount(board[known], values[known])
    return float(np.mean(total[count > 0] / count[count > 0])) if known.any() else np.inf


def _median(distances: Array) -> float:
    return float(np.nanmedian(distances)) if np.isfinite(distances).any() else np.inf


def _rms(distances: Array) -> float:
    limit = OUTLIER * _median(distances)
    kept = distances[distances <= limit]
    return float(np.sqrt(np.mean(kept**2))) if kept.size else np.inf
