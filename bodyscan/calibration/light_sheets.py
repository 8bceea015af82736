"""The light sheets of one pair: every model is tried, and held-out boards choose (3.2)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodyscan.arrays import Indices
from bodyscan.calibration.boundary_points import BoundaryPoints, subsample
from bodyscan.calibration.light_planes import PlaneFit, fit_light_planes
from bodyscan.calibration.model_selection import (
    Candidate,
    HeldOutModel,
    hold_out,
    select_model,
    split,
)
from bodyscan.calibration.pinhole_projector import fit_pinhole
from bodyscan.calibration.sheet_fit import SheetFit, fit_sheets
from bodyscan.errors import PairFailed
from bodyscan.geometry.bowed_sheets import BowedSheets
from bodyscan.geometry.lens_sheets import LensSheets
from bodyscan.geometry.light_planes import Axis, LightPlanes, LightSheets
from bodyscan.geometry.smooth_sheets import SmoothSheets

LEAST_MEASURED = 0.5
"""Share of held-out boards' points that a model gives a depth: one that fits gives all but a few at
the rim, and one that missed gives few or none."""
CHOICE_BINS, FIT_BINS = 4000, 25000
START_BINS, START_STEPS, FOLD_STEPS = 1000, 15, 8
AXIS_STARTS = (-0.5, 0.0, 0.5, 1.0, 1.5)
"""Starts for the projector's axis, in heights of its image."""
FEWEST_BOARDS, FEWEST_POINTS = 2, 50
PARTS = ("pinhole", "lens k1", "smooth planes")
"""Models without a term that real devices have; they are never chosen. Three or four boards hardly
show whether a term can be left out, and leaving it out by mistake costs several times as much as
fitting it with a prior that covers such devices."""
BINS_A_BOARD = 2
"""Bins of a boundary from which a board counts for a free plane."""


@dataclass(frozen=True, eq=False)
class SheetsFit:
    """The light sheets of a pair and how they were chosen.

    model: its name in `held_out`.
    held_out: figures of all models tried, simplest first.
    rms_mm: distance of boundary points from their sheets, robustly weighted RMS.
    board_error_mm: estimated error of the boards' poses, from the held-out distances.
    boards_seen: number of boards on which each boundary was seen, (S + 1,).
    """

    sheets: LightSheets
    model: str
    held_out: tuple[HeldOutModel, ...]
    rms_mm: float
    board_error_mm: float
    boards_seen: Indices

    @property
    def stripes_calibrated(self) -> int:
        """Number of boundaries between two stripes that have a sheet.

        For smooth models those seen on at least one board, for the chapter's planes on two.
        """
        if isinstance(self.sheets, LightPlanes):
            return int(self.sheets.calibrated[1:-1].sum())
        return int(np.count_nonzero(self.boards_seen[1:-1]))


def fit_light_sheets(bins: BoundaryPoints, stripes: int, direction: Axis) -> SheetsFit:
    """Fit light sheets to boundaries on two or more boards, camera frame.

    bins: means over pieces of boundaries.

    With two boards, halves of them are held out; with three or more, whole boards. Raises
    PairFailed with fewer than two boards, or with hardly any boundaries on them.
    """
    boards = len(np.unique(bins.board))
    if boards < FEWEST_BOARDS or len(bins.index) < FEWEST_POINTS:
        raise PairFailed(
            f"{len(bins.index)} points of stripe boundaries on {boards} boards are too few for "
            "sheets of light",
            remedy="capture the stripe sequence on the board in three or more poses",
        )
    few = subsample(bins, CHOICE_BINS)
    starts = smooth_models(few, stripes, direction)
    candidates = [_smooth_candidate(name, start) for name, start in starts]
    candidates.append(_planes_candidate(stripes, direction))
    folds = split(few)
    tried = [hold_out(candidate, few, folds) for candidate in candidates]
    chosen, figures = select_model(candidates, tried, few)
    error = tried[chosen].board_error_mm(few, folds)
    fit: SheetFit[SmoothSheets] | PlaneFit
    sheets: LightSheets
    if chosen < len(starts):
        fit = fit_sheets(starts[chosen][1], subsample(bins, FIT_BINS), board_error_mm=error)
        sheets = fit.sheets
        missed = any(one.chosen and one.measured < LEAST_MEASURED for one in figures)
        if missed or not np.isfinite(sheets.covariance).all():
            raise PairFailed(
                f"the stripes on {boards} boards fit no sheets of light",
                remedy="capture the stripe sequence on the board in more poses, nearer and farther",
            )
    else:
        fit = fit_planes(bins, stripes, direction, error)
        sheets = fit.planes
    return SheetsFit(
        sheets, candidates[chosen].name, figures, fit.rms_mm, error, count_boards(bins, stripes)
    )


def smooth_models(
    data: BoundaryPoints, stripes: int, direction: Axis
) -> list[tuple[str, SmoothSheets]]:
    """Fit the models whose sheets change smoothly with s to binned points; simplest first."""
    few = subsample(data, START_BINS)
    pinhole = fit_pinhole(few.points, few.index.astype(float))
    plain = pinhole.sheets(data.points, stripes, direction)
    lens = _lens_start(plain, few)
    models: list[tuple[str, SmoothSheets]] = [
        ("pinhole", plain),
        ("lens k1", lens.with_lens(1)),
        ("lens k1 k2", lens),
        ("lens k1 k2 p1 p2", lens.with_lens(4)),
        ("smooth planes", BowedSheets.from_pinhole(plain, 0)),
        ("bowed sheets", BowedSheets.from_pinhole(plain, 1)),
        ("bowed sheets, 3 terms", BowedSheets.from_pinhole(plain, 3)),
    ]
    return [(name, fit_sheets(model, data).sheets) for name, model in models]


def _lens_start(plain: LensSheets, data: BoundaryPoints) -> LensSheets:
    """A lens fitted from several starts along its axis.

    Planes hardly show where the axis is, and many projectors shine upwards, with their axis at the
    image's edge or outside it.
    """
    centres = [plain.parameters[1], *(share * plain.stripes for share in AXIS_STARTS)]
    starts = [plain.rotate_to(float(centre)).with_lens(2) for centre in centres]
    fits = [fit_sheets(start, data, most_steps=START_STEPS) for start in starts]
    return min(fits, key=lambda fit: np.nan_to_num(fit.noise, nan=np.inf)).sheets


def count_boards(data: BoundaryPoints, stripes: int) -> Indices:
    """Number of boards on which each boundary was seen, (S + 1,)."""
    boards = int(data.board.max(initial=0)) + 1
    points = np.bincount(data.index * boards + data.board, minlength=(stripes + 1) * boards)
    return np.count_nonzero(points.reshape(stripes + 1, boards), axis=1).astype(np.int64)


def fit_planes(
    bins: BoundaryPoints, stripes: int, direction: Axis, board_error_mm: float
) -> PlaneFit:
    """Fit the chapter's free planes to binned points."""
    return fit_light_planes(
        bins, stripes, direction, board_error_mm=board_error_mm, fewest_points=BINS_A_BOARD
    )


def _smooth_candidate(name: str, start: SmoothSheets) -> Candidate:
    def fit(data: BoundaryPoints) -> LightSheets:
        return fit_sheets(start, data, board_error_mm=1.0, most_steps=FOLD_STEPS).sheets

    return Candidate(name, fit, whole=name not in PARTS)


def _planes_candidate(stripes: int, direction: Axis) -> Candidate:
    def fit(data: BoundaryPoints) -> LightSheets:
        return fit_planes(data, stripes, direction, 1.0).planes

    return Candidate("free planes", fit, everywhere=False)
