"""Choose models by held-out boards: compare two models, and select the light model of a pair.

With residuals r of the richer model and r + d of the simpler one, squares differ by d^2 + 2 r d:
the first term is the difference of the models, the second is due to noise, and its standard error
follows from its sums over independent parts. Models are compared by differences at the same points,
never by a ratio of noisy totals.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from bodyscan.arrays import Array, Indices, Mask
from bodyscan.calibration.boundary_points import BoundaryPoints, select
from bodyscan.geometry.light_planes import LightSheets
from bodyscan.geometry.robust import (
    SIGMAS_PER_MEDIAN,
    compute_cauchy_weights,
    estimate_robust_scale,
    rms,
)

MIN_GAIN = 3.0
"""Standard errors by which a richer model must be better: by chance once in 700 times."""
MAX_FOLDS = 6
OUTLIER = 4.0 * SIGMAS_PER_MEDIAN


@dataclass(frozen=True, eq=False)
class ResidualPair:
    """Residuals (N, D) of the same points in two models, simple and rich.

    cluster: (N,) number of the cluster of each point, such as its board. Errors are correlated
        within a cluster and independent between clusters.
    """

    simple: Array
    rich: Array
    cluster: Indices


def compute_shared_weights(tried: Sequence[Array]) -> Array:
    """Robust weights (N,) of points with residuals (N, D) in each model: low where none fits."""
    size = tried[0].shape[1]
    smallest = np.min([np.sum(residuals**2, axis=1) for residuals in tried], axis=0)
    sigma = min(estimate_robust_scale(residuals.ravel()) for residuals in tried)
    scaled = np.repeat(np.sqrt(smallest / size), size) / sigma
    return np.asarray(compute_cauchy_weights(scaled, size, 4.0)[::size], np.float64)


def gain(pair: ResidualPair) -> float:
    """Compute by how many standard errors the richer model lowers held-out squared residuals."""
    sigma = min(estimate_robust_scale(residuals.ravel()) for residuals in (pair.simple, pair.rich))
    weights = compute_shared_weights([pair.simple, pair.rich]) / sigma**2
    gained = float(np.sum(weights * np.sum(pair.simple**2 - pair.rich**2, axis=1)))
    noise = weights * np.sum(2.0 * pair.rich * (pair.simple - pair.rich), axis=1)
    deviation = float(np.sqrt(np.sum(np.bincount(pair.cluster, noise) ** 2)))
    return gained / max(deviation, 1e-12)


@dataclass(frozen=True)
class Candidate:
    """A light model to try; candidates are listed simplest first.

    fit: sheets from points, with the covariance for boards displaced by 1 mm.
    complete: gives sheets for every s, so that a ray it cannot measure counts against it.
    """

    name: str
    fit: Callable[[BoundaryPoints], LightSheets]
    complete: bool = True


@dataclass(frozen=True)
class HeldOutModel:
    """How well one model measured held-out boards, as distances from the board, mm."""

    model: str
    mean_mm: float  # mean absolute distance, outliers capped, every board weighted the same
    median_mm: float
    rms_mm: float  # RMS distance without outliers
    measured: float  # share of the points that got a depth
    chosen: bool = False
    # Standard errors by which it beat the model chosen among those before it, three being required;
    # None for the first.
    gain: float | None = None


@dataclass(frozen=True, eq=False)
class HeldOutErrors:
    """Distances of held-out points from their boards, as measured by sheets fitted without them."""

    distances: Array  # (N,) mm, NaN where not measured
    unit_variance: Array  # (N,) mm^2 of the distances if boards were known to 1 mm

    def board_error_mm(self, data: BoundaryPoints) -> float:
        """Estimate the error of the boards' poses, mm, that explains distances as large as these.

        data: the points that were held out. Their noise, by the differences of neighbours on a
            boundary, is subtracted.
        """
        known = np.isfinite(self.distances) & np.isfinite(self.unit_variance)
        squared = self.distances[known] ** 2
        if not squared.size:
            return 0.0
        limit = OUTLIER**2 * np.median(squared)
        total = np.minimum(squared, limit).mean()
        neighbours = (np.diff(data.index) == 0) & (np.diff(data.board) == 0)
        steps = np.diff(self.distances)[neighbours]
        steps = steps[np.isfinite(steps)]
        noise = 0.5 * estimate_robust_scale(steps) ** 2 if steps.size else 0.0
        # Boards are never assumed to account for less than a hundredth.
        left = max(total - noise, 0.01 * total)
        return float(np.sqrt(left / self.unit_variance[known].mean()))


def split(data: BoundaryPoints) -> list[Mask]:
    """Split the points so that each is left out once; (N,) for each fold, true for those left out.

    They are left out by boards, in MAX_FOLDS groups at most; with only two boards, by halves of
    one.
    """
    boards, number = np.unique(data.board, return_inverse=True)
    if len(boards) > 2:
        group = number % MAX_FOLDS
    else:
        group = 2 * number + (data.board_errors.effects[:, 2] > 0.0)
    return [group == k for k in np.unique(group)]


def hold_out(candidate: Candidate, data: BoundaryPoints, folds: Sequence[Mask]) -> HeldOutErrors:
    """Fit without each fold in turn, and measure what was left out."""
    errors, distances = data.board_errors, np.full(len(data.index), np.nan)
    unit_variance = np.sum(errors.effects**2, axis=1)
    for left_out in folds:
        points, facing = data.points[left_out], errors.facing[left_out]
        sheets = candidate.fit(select(data, ~left_out))
        found = sheets.intersect(points / points[:, 2:], data.index[left_out].astype(float))
        distances[left_out] = (found.depth - points[:, 2]) * facing
        unit_variance[left_out] += found.variance_mm2 * facing**2
    return HeldOutErrors(distances, unit_variance)


def select_model(
    candidates: Sequence[Candidate], tried: Sequence[HeldOutErrors], data: BoundaryPoints
) -> tuple[int, tuple[HeldOutModel, ...]]:
    """Select a model; return its index and the figures of all that measured anything.

    data: the points held out.

    Each model is compared with the one selected so far, and replaces it if clearly better. The pose
    of a held-out board is fitted with either model, so that only the light differs. Models that give
    no depth where a stripe was seen too seldom are compared only where they give one.
    """
    medians = [_compute_median(np.abs(errors.distances)) for errors in tried]
    cap = 30.0 * min(medians)
    cluster, effects, board = _number_board_ninths(data), data.board_errors.effects, data.board
    counted = [
        np.isfinite(errors.distances) | candidate.complete
        for candidate, errors in zip(candidates, tried, strict=True)
    ]
    chosen = 0
    gains: list[float | None] = [None] * len(candidates)
    for i in range(1, len(candidates)):
        known = counted[i]
        if not np.isfinite(medians[i]):
            continue
        rich, simple = (
            _subtract_motion(_clip(tried[k].distances[known], cap), effects[known], board[known])
            for k in (i, chosen)
        )
        better_by = gain(ResidualPair(simple[:, None], rich[:, None], cluster[known]))
        gains[i] = better_by
        chosen = i if better_by >= MIN_GAIN else chosen
    figures = tuple(
        HeldOutModel(
            candidate.name,
            _average_boards(np.abs(_clip(errors.distances, cap)), board, counted[i]),
            medians[i],
            _compute_rms(np.abs(errors.distances)),
            float(np.isfinite(errors.distances).mean()),
            i == chosen,
            gains[i],
        )
        for i, (candidate, errors) in enumerate(zip(candidates, tried, strict=True))
        if np.isfinite(medians[i])
    )
    return chosen, figures


def _number_board_ninths(data: BoundaryPoints) -> Indices:
    """Number (N,) of the ninth of its board in which each point lies."""
    # Thirds along an axis, in standard deviations of the points there.
    across, down = (np.digitize(xy, (-0.6, 0.6)) for xy in data.board_errors.effects[:, 1:].T)
    _, board = np.unique(data.board, return_inverse=True)
    return np.asarray(9 * board + 3 * across + down, np.int64)


def _subtract_motion(distances: Array, effects: Array, board: Indices) -> Array:
    """Subtract from distances (N,) the shift and tilts that fit each board best, by trimmed least
    squares; effects: see `BoardErrors`."""
    remaining = distances.copy()
    for number in np.unique(board):
        points = board == number
        kept = np.ones(np.count_nonzero(points), bool)
        for _ in range(3):
            motion = np.linalg.lstsq(effects[points][kept], distances[points][kept], rcond=None)[0]
            remaining[points] = distances[points] - effects[points] @ motion
            size = np.abs(remaining[points])
            kept = size <= OUTLIER * max(float(np.median(size)), 1e-9)
    return remaining


def _clip(distances: Array, cap: float) -> Array:
    """Clip distances at `cap`; points that were not measured count as that far off."""
    return np.asarray(np.clip(np.nan_to_num(distances, nan=cap), -cap, cap), np.float64)


def _average_boards(values: Array, board: Indices, known: Mask) -> float:
    """Mean over boards of the mean of each, so that every board counts the same."""
    count, total = np.bincount(board[known]), np.bincount(board[known], values[known])
    return float(np.mean(total[count > 0] / count[count > 0])) if known.any() else np.inf


def _compute_median(distances: Array) -> float:
    return float(np.nanmedian(distances)) if np.isfinite(distances).any() else np.inf


def _compute_rms(distances: Array) -> float:
    limit = OUTLIER * _compute_median(distances)
    kept = distances[distances <= limit]
    return rms(kept) if kept.size else np.inf
