"""The light of one pair: every model of its sheets is tried, held-out boards choose (3.2)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bodyscan.calibration.boundary_points import BoundaryPoints, binned, thinned
from bodyscan.calibration.light_choice import Candidate, HeldOutModel, choose, folds, hold_out
from bodyscan.calibration.light_planes import PlaneFit, fit_light_planes
from bodyscan.calibration.pinhole_projector import fit_pinhole
from bodyscan.calibration.sheet_fit import SheetFit, fit_sheets
from bodyscan.geometry.bowed_sheets import BowedSheets
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.light_planes import Axis, LightPlanes, LightSheets
from bodyscan.geometry.smooth_sheets import SmoothSheets

Array = NDArray[np.float64]

CHOICE_BINS = 4000
FIT_BINS = 25000
START_BINS = 1500
BINS_A_BOARD = 2
"""So many bins of a boundary make a board count for a free plane."""


@dataclass(frozen=True, eq=False)
class LightFit:
    """model: its name in `held_out`, the figures of all that were tried, simplest first.

    rms_mm: distance of boundary points to their sheets, robustly weighted root mean square.
    board_error_mm: how far out of place boards seem to be, from the held-out distances.
    boards_seen: (S + 1,) on how many boards each boundary was seen.
    """

    sheets: LightSheets
    model: str
    held_out: tuple[HeldOutModel, ...]
    rms_mm: float
    board_error_mm: float
    boards_seen: NDArray[np.int64]

    @property
    def stripes_calibrated(self) -> int:
        """Boundaries between two stripes that have a sheet: those seen on at least one board, for
        the chapter's planes on two."""
        if isinstance(self.sheets, LightPlanes):
            return int(self.sheets.calibrated[1:-1].sum())
        return int(np.count_nonzero(self.boards_seen[1:-1]))


def fit_light(data: BoundaryPoints, stripes: int, direction: Axis, camera: Camera) -> LightFit:
    """Sheets of light from boundaries on two or more boards, camera frame.

    With two boards halves of them are held out, with three or more whole boards.
    """
    bins = binned(data, camera, direction)
    few = thinned(bins, CHOICE_BINS)
    starts = smooth_models(few, stripes, direction)
    candidates = [_smooth_candidate(name, start) for name, start in starts]
    candidates.append(_planes_candidate(stripes, direction))
    fold = folds(few)
    tried = [hold_out(candidate, few, fold) for candidate in candidates]
    chosen, figures = choose(candidates, tried, few.board)
    error = tried[chosen].board_error_mm()
    fit: SheetFit[SmoothSheets] | PlaneFit
    sheets: LightSheets
    if chosen < len(starts):
        fit = fit_sheets(starts[chosen][1], thinned(bins, FIT_BINS), board_error_mm=error)
        sheets = fit.sheets
    else:
        fit = fit_planes(bins, stripes, direction, error)
        sheets = fit.planes
    pairs = np.unique(np.stack([data.index, data.board]), axis=1)
    seen = np.bincount(pairs[0], minlength=stripes + 1)
    return LightFit(sheets, figures[chosen].model, figures, fit.rms_mm, error, seen)


def smooth_models(
    data: BoundaryPoints, stripes: int, direction: Axis
) -> list[tuple[str, SmoothSheets]]:
    """The models whose sheets change smoothly with s, simplest first, fitted to binned points."""
    start = thinned(data, START_BINS)
    pinhole = fit_pinhole(start.points, start.index.astype(float))
    plain = pinhole.sheets(data.points, stripes, direction)
    models: list[tuple[str, SmoothSheets]] = [("pinhole", plain)]
    lens = plain
    for terms, name in ((1, "lens k1"), (2, "lens k1 k2"), (4, "lens k1 k2 p1 p2")):
        lens = fit_sheets(lens.with_lens(terms), data).sheets
        models.append((name, lens))
    for terms, name in ((0, "smooth planes"), (1, "bowed sheets"), (3, "bowed sheets, 3 terms")):
        models.append((name, BowedSheets.of_pinhole(plain, terms)))
    return [(name, fit_sheets(model, data).sheets) for name, model in models]


def fit_planes(
    bins: BoundaryPoints, stripes: int, direction: Axis, board_error_mm: float
) -> PlaneFit:
    """The chapter's free planes from binned points."""
    return fit_light_planes(
        bins, stripes, direction, board_error_mm=board_error_mm, fewest_points=BINS_A_BOARD
    )


def _smooth_candidate(name: str, start: SmoothSheets) -> Candidate:
    return Candidate(name, lambda data: fit_sheets(start, data, board_error_mm=1.0).sheets)


def _planes_candidate(stripes: int, direction: Axis) -> Candidate:
    return Candidate(
        "free planes", lambda data: fit_planes(data, stripes, direction, 1.0).planes, False
    )
