"""Choose the model of the light that a pair needs, by held-out boards."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from bodyscan.arrays import Array, Indices, Mask
from bodyscan.calibration.boundary_points import BoundaryPoints, select
from bodyscan.calibration.held_out import CLEARLY, Compared, gain
from bodyscan.geometry.light_planes import LightSheets
from bodyscan.geometry.robust import SIGMAS_PER_MEDIAN, rms, robust_scale

MOST_FOLDS = 6
CAP = 30.0
"""No point counts for more than this many times the best model's median distance."""
THIRDS = (-0.6, 0.6)
"""Cuts a board into thirds along an axis, in standard deviations of its points' places there."""
OUTLIER = 4.0 * SIGMAS_PER_MEDIAN
TRIMS = 3
LEAST_SHARE = 0.01
"""Boards are never assumed to be known so well that they account for less than this share of the
squared held-out distances."""


@dataclass(frozen=True)
class Candidate:
    """A model to try; candidates are listed simplest first.

    fit: sheets from points, with the covariance for boards 1 mm out of place.
    everywhere: gives sheets for every s, so that a ray it cannot measure counts against it.
    whole: has all terms that such devices have, and may be chosen; others are tried for
        information.
    """

    name: str
    fit: Callable[[BoundaryPoints], LightSheets]
    everywhere: bool = True
    whole: bool = True


@dataclass(frozen=True)
class HeldOutModel:
    """How well one model measured held-out boards, as distances from the board, mm.

    mean_mm: mean absolute distance, outliers capped, every board weighted the same.
    median_mm: median absolute distance.
    rms_mm: RMS distance without outliers.
    measured: share of the points that got a depth.
    chosen: whether this model is used.
    gain: standard errors by which it beat the model chosen among those before it, three being
        required; None for the first that may be chosen, and for models that may not be.
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
    """One split of the points.

    left_out: the points to be measured, (N,).
    rest: the others, to which models are fitted.
    """

    left_out: Mask
    rest: BoundaryPoints


@dataclass(frozen=True, eq=False)
class HeldOutErrors:
    """Distances measured with sheets that were fitted without the measured points.

    distances: of the points from their boards, (N,) mm, NaN where not measured.
    sheets: those fitted without each fold.
    """

    distances: Array
    sheets: tuple[LightSheets, ...]

    def unit_variance(self, data: BoundaryPoints, folds: Sequence[Fold]) -> Array:
        """(N,) mm^2: variance of the distances if boards were known to 1 mm (see `BoardErrors`)."""
        errors = data.board_errors
        variance = np.sum(errors.effects**2, axis=1)
        for fold, sheets in zip(folds, self.sheets, strict=True):
            rays, s, _ = _measured(data, fold)
            own = sheets.variance_mm2(rays, s, sheets.depth(rays, s))
            variance[fold.left_out] += own * errors.facing[fold.left_out] ** 2
        return variance

    def board_error_mm(self, data: BoundaryPoints, folds: Sequence[Fold]) -> float:
        """Error of the boards' poses, mm, that would explain distances as large as these.

        data: the points that were held out. Their own noise, seen in the differences of neighbours
            on a boundary, is subtracted.
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
        noise = 0.5 * robust_scale(steps) ** 2 if steps.size else 0.0
        left = max(total - noise, LEAST_SHARE * total)
        return float(np.sqrt(left / unit_variance[known].mean()))


def split(data: BoundaryPoints) -> list[Fold]:
    """Split the points so that each is left out once.

    They are left out by boards, in MOST_FOLDS groups at most; with only two boards, by halves of
    one.
    """
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
    """Rays (n, 3) with z = 1, s (n,) and true depths (n,) mm of the points left out."""
    points, s = data.points[fold.left_out], data.index[fold.left_out].astype(float)
    return points / points[:, 2:], s, points[:, 2]


def select_model(
    candidates: Sequence[Candidate], tried: Sequence[HeldOutErrors], data: BoundaryPoints
) -> tuple[int, tuple[HeldOutModel, ...]]:
    """Choose a model; return its number and the figures of all that measured anything.

    data: the points held out.

    Each model is compared with the one chosen so far, and taken if clearly better. The pose of a
    held-out board is fitted with either model, so that only the light differs. Models that give no
    depth where a stripe was seen too seldom are compared only where they give one.
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
    """Number (N,) of the ninth of its board in which each point lies."""
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
    """Clip distances; points that were not measured count as far off."""
    return np.asarray(np.clip(np.nan_to_num(distances, nan=cap), -cap, cap), np.float64)


def _mean_of_boards(values: Array, board: Indices, known: Mask) -> float:
    """Mean over boards of the mean of each, so that every board counts the same."""
    count, total = np.bincount(board[known]), np.bincount(board[known], values[known])
    return float(np.mean(total[count > 0] / count[count > 0])) if known.any() else np.inf


def _median(distances: Array) -> float:
    return float(np.nanmedian(distances)) if np.isfinite(distances).any() else np.inf


def _rms(distances: Array) -> float:
    limit = OUTLIER * _median(distances)
    kept = distances[distances <= limit]
    return rms(kept) if kept.size else np.inf
