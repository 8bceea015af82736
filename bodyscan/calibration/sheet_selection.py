"""Choose the model of one pair's light sheets by held-out boards, and fit it to all (3.2)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from bodyscan.arrays import Indices
from bodyscan.calibration.boundary_points import FIT_BINS, BoundaryPoints, subsample
from bodyscan.calibration.model_selection import (
    Candidate,
    HeldOutModel,
    hold_out,
    select_model,
    split,
)
from bodyscan.calibration.sheet_fit import (
    PlaneFit,
    SheetFit,
    count_boards,
    fit_light_planes,
    fit_pinhole,
    fit_sheets,
)
from bodyscan.errors import PairFailed
from bodyscan.geometry.bowed_sheets import BowedSheets
from bodyscan.geometry.lens_sheets import LensSheets
from bodyscan.geometry.light_planes import Axis, LightPlanes, LightSheets, SmoothSheets


@dataclass(frozen=True, eq=False)
class SheetsFit:
    """The light sheets of a pair and how they were chosen."""

    sheets: LightSheets
    model: str  # its name in `held_out`
    held_out: tuple[HeldOutModel, ...]  # figures of all models tried, simplest first
    rms_mm: float  # distance of boundary points from their sheets, robustly weighted RMS
    board_counts: Indices  # number of boards on which each boundary was found, (S + 1,)

    @property
    def stripes_calibrated(self) -> int:
        """Number of boundaries between two stripes that have a sheet.

        For smooth models those on at least one board, for the chapter's planes on two. The middle of
        a single line counts as one.
        """
        found = self.board_counts > 0
        if isinstance(self.sheets, LightPlanes):
            found = self.sheets.calibrated
        return int(np.count_nonzero(found[1:-1] if len(found) > 2 else found))


def fit_light_sheets(bins: BoundaryPoints, stripes: int, direction: Axis) -> SheetsFit:
    """Fit light sheets to boundaries on two or more boards, camera frame.

    bins: means over pieces of boundaries.

    With two boards, halves of them are held out; with three or more, whole boards. Raises
    PairFailed with fewer than two boards, or with hardly any boundaries on them.
    """
    boards = len(np.unique(bins.board))
    if boards < 2 or len(bins.index) < (50 if stripes > 1 else 12):
        raise PairFailed(
            f"{len(bins.index)} points of stripe boundaries on {boards} boards are too few for "
            "light sheets",
            remedy="capture the stripe sequence on the board in three or more poses",
        )
    few = subsample(bins, 4000)
    starts = smooth_models(few, stripes, direction)
    candidates = [Candidate(name, partial(_fit_held_out, start)) for name, start in starts]

    def fit_planes(data: BoundaryPoints, board_error_mm: float = 1.0) -> PlaneFit:
        # Boards count from two bins of a boundary.
        return fit_light_planes(
            data, stripes, direction, board_error_mm=board_error_mm, min_points=2
        )

    planes = Candidate("free planes", lambda data: fit_planes(data).planes, complete=False)
    candidates.append(planes)
    folds = split(few)
    tried = [hold_out(candidate, few, folds) for candidate in candidates]
    chosen, figures = select_model(candidates, tried, few)
    error = tried[chosen].board_error_mm(few)
    fit: SheetFit[SmoothSheets] | PlaneFit
    sheets: LightSheets
    if chosen < len(starts):
        fit = fit_sheets(starts[chosen][1], subsample(bins, FIT_BINS), board_error_mm=error)
        sheets = fit.sheets
        # A model that fits gives a depth to all points but a few at the rim.
        missed = any(figure.chosen and figure.measured < 0.5 for figure in figures)
        if missed or not np.isfinite(sheets.covariance).all():
            raise PairFailed(
                f"the stripes on {boards} boards fit no light sheets",
                remedy="capture the stripe sequence on the board in more poses, nearer and farther",
            )
    else:
        fit = fit_planes(bins, error)
        sheets = fit.planes
    return SheetsFit(
        sheets, candidates[chosen].name, figures, fit.rms_mm, count_boards(bins, stripes)
    )


def smooth_models(
    data: BoundaryPoints, stripes: int, direction: Axis
) -> list[tuple[str, SmoothSheets]]:
    """Fit the models whose sheets change smoothly with s to binned points; simplest first.

    Real devices have the terms of all of them. Three or four boards hardly show whether a term can be
    left out, and leaving it out by mistake costs several times as much as fitting it with a prior
    that covers such devices: a pinhole, k1 alone and planes without a bow are not tried.
    """
    few = subsample(data, 1000)
    pinhole = fit_pinhole(few.points, few.index.astype(float))
    plain = LensSheets.from_matrix(pinhole, data.points.mean(axis=0), stripes, direction)
    models: list[tuple[str, SmoothSheets]] = [
        ("bowed sheets", BowedSheets.from_pinhole(plain, 1)),
        ("bowed sheets, 3 terms", BowedSheets.from_pinhole(plain, 3)),
    ]
    if stripes > 1:  # one sheet shows no lens
        lens = _find_lens_start(plain, few)
        models = [("lens k1 k2", lens), ("lens k1 k2 p1 p2", lens.with_lens(4)), *models]
    return [(name, fit_sheets(model, data).sheets) for name, model in models]


def _find_lens_start(plain: LensSheets, data: BoundaryPoints) -> LensSheets:
    """Fit a lens from several starts of its axis, in heights of the image. Planes hardly determine the
    axis, and many projectors shine upwards, with their axis at the image's edge or outside it."""
    centres = [plain.parameters[1], *(h * plain.stripes for h in (-0.5, 0.0, 0.5, 1.0, 1.5))]
    starts = [plain.rotate_to(float(centre)).with_lens(2) for centre in centres]
    fits = [fit_sheets(start, data, max_steps=15) for start in starts]
    return min(fits, key=lambda fit: np.nan_to_num(fit.noise, nan=np.inf)).sheets


def _fit_held_out(start: SmoothSheets, data: BoundaryPoints) -> LightSheets:
    return fit_sheets(start, data, board_error_mm=1.0, max_steps=8).sheets
