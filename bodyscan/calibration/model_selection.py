"""Which model of the light a pair needs, found from boards that the model was not fitted to."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from bodyscan.arrays import Array, Indices, Mask
from bodyscan.calibration.boundary_points import BoundaryPoints, select
from bodyscan.calibration.held_out import CLEARLY, Compared, gain
from bodyscan.geometry.light_planes import LightSheets
from bodyscan.geometry.robust import SIGMAS_PER_MEDIAN, rms, spread

MOST_FOLDS = 6
CAP = 30.0
"""No point counts for more than this many times the best model's median."""
THIRDS = (-0.6, 0.6)
"""Cut a board in three along an axis, in standard deviations of its points' places there."""
OUTLIER = 4.0 * SIGMAS_PER_MEDIAN
TRIMS = 3
LEAST_SHARE = 0.01
"""Boards are never taken for known so well that less than this share of the squared held-out
distances is theirs."""


@dataclass(frozen=True)
class Candidate:
    """A model to try; candidates are listed simplest first.

    fit: sheets from points, with the covariance of boards 1 mm out of place.
    everywhere: gives sheets for every s, so that a ray it cannot measure counts against it.
    whole: has all terms that such devices have, so that it may be chosen; others are tried to be told.
    """

    name: str
    fit: Callable[[BoundaryPoints], LightSheets]
    everywhere: bool = True
    whole: bool = True


@dataclass(frozen=True)
class HeldOutModel:
    """How well one model measured boards that it was not fitted to, mm from the board.

    mean_mm: of the absolute distances, outliers capped, board by board.  median_mm: of all absolute
    distances.  rms_mm: without outliers.  measured: share of the points that got a depth.  chosen:
    whether this model is used.  gain: by how many standard errors it beat the model chosen among those
    before it, which it had to by three; None for the first of those that may be chosen, and for what is
    but a part of another.
    """

    model: str
    mean_mm: float
    median_mm: float
    rms_mm: float
    measured: float
    chosen: bool = False
    gain: float | None = None


@dataclass(frozen=True, eq=False)
class Fold:
    """left_out: (N,) the points that are measured.  rest: the others, which models are fitted to."""

    left_out: Mask
    rest: BoundaryPoints


@dataclass(frozen=True, eq=False)
class HeldOutErrors:
    """distances: (N,) mm of the measured points from their boards, NaN where not measured.

    sheets: fitted without each fold.
    """

    distances: Array
    sheets: tuple[LightSheets, ...]

    def unit_variance(self, data: BoundaryPoints, folds: Sequence[Fold]) -> Array:
        """(N,) mm^2, what the distances would be if boards were known to 1 mm (see `BoardErrors`)."""
        errors = data.board_errors
        variance = np.sum(errors.effects**2, axis=1)
        for fold, sheets in zip(folds, self.sheets, strict=True):
            rays, s, _ = _measured(data, fold)
            own = sheets.variance_mm2(rays, s, sheets.depth(rays, s))
            variance[fold.left_out] += own * errors.facing[fold.left_out] ** 2
        return variance

    def board_error_mm(self, data: BoundaryPoints, folds: Sequence[Fold]) -> float:
        """How far out of place boards must be, for distances as large as these are.

        data: the points that were held out. Their own noise, seen in how neighbours on a boundary
        differ, is taken off.
        """
        unit_variance = self.unit_variance(data, folds)
        known = np.isfinite(self.distances) & np.isfinite(unit_variance)
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
        return float(np.sqrt(left / unit_variance[known].mean()))


def split(data: BoundaryPoints) -> list[Fold]:
    """The points, each left out once: by boards, in MOST_FOLDS groups at most; with only two boards, by
    halves of one."""
    boards, number = np.unique(data.board, return_inverse=True)
    if len(boards) > 2:
        group = number % MOST_FOLDS
    else:
        group = 2 * number + (data.board_errors.effects[:, 2] > 0.0)
    return [Fold(group == k, select(data, group != k)) for k in np.unique(group)]


def hold_out(candidate: Candidate, data: BoundaryPoints, folds: Sequence[Fold]) -> HeldOutErrors:
    """Fit without each fold in turn, and measure what was left out."""
    distances, fitted = np.full(len(data.index), np.nan), []
    for fold in folds:
        sheets = candidate.fit(fold.rest)
        rays, s, depth = _measured(data, fold)
        facing = data.board_errors.facing[fold.left_out]
        distances[fold.left_out] = (sheets.depth(rays, s) - depth) * facing
        fitted.append(sheets)
    return HeldOutErrors(distances, tuple(fitted))


def _measured(data: BoundaryPoints, fold: Fold) -> tuple[Array, Array, Array]:
    """Of the points left out: rays (n, 3) with z = 1, s (n,), and their own depth (n,) mm."""
    points, s = data.points[fold.left_out], data.index[fold.left_out].astype(float)
    return points / points[:, 2:], s, points[:, 2]


def select_model(
    candidates: Sequence[Candidate], tried: Sequence[HeldOutErrors], data: BoundaryPoints
) -> tuple[int, tuple[HeldOutModel, ...]]:
    """The number of the model to use, and the figures of all that measured anything.

    Each is compared with the one chosen so far, and taken where it is clearly better.  How a held-out
    board lies is fitted to either, so that nothing but the light differs.  Models that give no depth
    where a stripe was seen too seldom are compared only where they do.

    data: the points held out.
    """
    medians = [_median(np.abs(errors.distances)) for errors in tried]
    cap = CAP * min(medians)
    part, effects, board = parts_of_boards(data), data.board_errors.effects, data.board
    seen = [
        np.isfinite(errors.distances) | candidate.everywhere
        for candidate, errors in zip(candidates, tried, strict=True)
    ]
    chosen = next(i for i, candidate in enumerate(candidates) if candidate.whole)
    gains: list[float | None] = [None] * len(candidates)
    for i in range(chosen + 1, len(candidates)):
        known = seen[i]
        if not (candidates[i].whole and np.isfinite(medians[i])):
            continue
        rich, simple = (
            without_motion(capped(tried[k].distances[known], cap), effects[known], board[known])
            for k in (i, chosen)
        )
        better_by = gain(Compared(simple[:, None], rich[:, None], part[known]))
        gains[i] = better_by
        chosen = i if better_by >= CLEARLY else chosen
    figures = tuple(
        HeldOutModel(
            candidate.name,
            _mean_of_boards(np.abs(capped(errors.distances, cap)), board, seen[i]),
            medians[i],
            _rms(np.abs(errors.distances)),
            float(np.isfinite(errors.distances).mean()),
            i == chosen,
            gains[i],
        )
        for i, (candidate, errors) in enumerate(zip(candidates, tried, strict=True))
        if np.isfinite(medians[i])
    )
    return chosen, figures


def parts_of_boards(data: BoundaryPoints) -> Indices:
    """(N,) number of the ninth of its board in which each point lies."""
    across, down = (np.digitize(place, THIRDS) for place in data.board_errors.effects[:, 1:].T)
    _, board = np.unique(data.board, return_inverse=True)
    return np.asarray(9 * board + 3 * across + down, np.int64)


def without_motion(distances: Array, effects: Array, board: Indices) -> Array:
    """Distances (N,) less the shift and tilts (`BoardErrors.effects`) that fit each board best."""
    left = distances.copy()
    for number in np.unique(board):
        own = board == number
        kept = np.ones(np.count_nonzero(own), bool)
        for _ in range(TRIMS):
            motion = np.linalg.lstsq(effects[own][kept], distances[own][kept], rcond=None)[0]
            left[own] = distances[own] - effects[own] @ motion
            off = np.abs(left[own])
            kept = off <= OUTLIER * max(float(np.median(off)), 1e-9)
    return left


def capped(distances: Array, cap: float) -> Array:
    """What was not measured counts as far off."""
    return np.asarray(np.clip(np.nan_to_num(distances, nan=cap), -cap, cap), np.float64)


def _mean_of_boards(values: Array, board: Indices, known: Mask) -> float:
    """Every board counts the same, however many points it has."""
    count, total = np.bincount(board[known]), np.bincount(board[known], values[known])
    return float(np.mean(total[count > 0] / count[count > 0])) if known.any() else np.inf


def _median(distances: Array) -> float:
    return float(np.nanmedian(distances)) if np.isfinite(distances).any() else np.inf


def _rms(distances: Array) -> float:
    limit = OUTLIER * _median(distances)
    kept = distances[distances <= limit]
    return rms(kept) if kept.size else np.inf
