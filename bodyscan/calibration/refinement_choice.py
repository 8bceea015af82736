"""Decide by held-out boards whether to refine camera, boards and light sheets together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bodyscan.arrays import Array
from bodyscan.calibration.board_form import BoardForm, PrintSpread
from bodyscan.calibration.boundary_points import BoundaryPoints, concatenate
from bodyscan.calibration.camera import CameraCalibration, fit_camera, locate_board
from bodyscan.calibration.held_out import CLEARLY, Compared, gain, shared_weights
from bodyscan.calibration.joint_refinement import (
    JointFit,
    StripedBoard,
    allowing_for,
    carried,
    known_apart,
    print_errors,
    refine_jointly,
)
from bodyscan.calibration.model_selection import (
    CAP,
    MOST_FOLDS,
    capped,
    parts_of_boards,
    without_motion,
)
from bodyscan.calibration.sheet_fit import fit_sheets
from bodyscan.geometry.light_planes import LightSheets
from bodyscan.geometry.smooth_sheets import SmoothSheets

FEWEST_BOARDS = 3
REFINED_BINS = 6000
"""Bins of boundaries that determine camera, boards and sheets to a tenth as well as all bins do."""
FOLD_STEPS = 5
"""A fold's solution lies less than a standard deviation from the solution with all boards."""
PRINT = PrintSpread(0.05)
"""Of a corner's printed place, to begin with: what office printers and plotters do."""
WAYS = APART, TOGETHER, BENT = (
    "corners, then stripes",
    "joint solve",
    "joint solve with bent boards",
)
NEEDED = (0.0, 0.0, CLEARLY)
"""Standard errors by which each must beat the one before. A joint solve has no more unknowns than
corners and stripes in turn, only more evidence on them, and is refused only where held-out boards
get worse. Bent boards are a richer model."""


@dataclass(frozen=True)
class RefinementTrial:
    """One method of solving for a pair.

    rms_mm: RMS distance of held-out boards' stripes from the boards, the boards' motion removed.
    gain: standard errors by which it beat the method chosen among those before it (see NEEDED);
        None for the first.
    """

    way: str
    rms_mm: float
    gain: float | None = None
    chosen: bool = False


@dataclass(frozen=True, eq=False)
class Refinement:
    """The method chosen.

    fit: its camera, boards and sheets, None if none could be tried.
    taken: whether they differ from those before.
    reason: of the choice, in words.
    """

    fit: JointFit[SmoothSheets] | None
    taken: bool
    reason: str
    trials: tuple[RefinementTrial, ...] = ()

    @property
    def flatness_mm(self) -> tuple[float, float] | None:
        """RMS of held-out boards' stripes with the first method and with the one chosen."""
        chosen = [trial.rms_mm for trial in self.trials if trial.chosen]
        return (self.trials[0].rms_mm, chosen[0]) if chosen else None


def refine_where_better(
    calibration: CameraCalibration,
    sheets: LightSheets,
    boards: Sequence[StripedBoard],
    data: BoundaryPoints,
    flatness_mm: Mapping[str, float],
) -> Refinement:
    """Refine jointly if that predicts boards better whose stripes took no part.

    boards: in the order of `data.board`.
    data: binned boundary points of the unrefined calibration.
    flatness_mm: how far boards may be bent, by name.
    """
    if not isinstance(sheets, SmoothSheets):
        return Refinement(None, False, "free planes are not refined")
    camera, poses = calibration.camera, calibration.camera_from_board
    forms = {name: _flat(name, boards, mm) for name, mm in sorted(flatness_mm.items())}
    first = refine_jointly(camera, poses, sheets, boards, forms)
    printed = print_errors(first, boards)
    forms = {name: replace(form, print_spread=printed[name]) for name, form in forms.items()}
    apart = known_apart(camera, poses, sheets, boards, forms)
    if len(boards) < FEWEST_BOARDS:
        return Refinement(apart, False, f"{len(boards)} boards with stripes are too few")
    found = {name: replace(form, print_spread=printed[name]) for name, form in first.forms.items()}
    fits = [
        apart,
        refine_jointly(camera, poses, sheets, boards, forms, bent=False),
        refine_jointly(first.camera, first.camera_from_board, first.sheets, boards, found),
    ]
    held = _hold_out(fits, boards, data)
    parts = (
        parts_of_boards(data),
        np.repeat(np.arange(len(boards)), [len(board.view.points) for board in boards]),
    )
    chosen = 0
    gains: list[float | None] = [None] * len(fits)
    for i in range(1, len(fits)):
        gains[i] = better_by = gain(
            Compared(held[chosen].stripes, held[i].stripes, parts[0]),
            Compared(held[chosen].corners, held[i].corners, parts[1]),
        )
        chosen = i if better_by >= NEEDED[i] else chosen
    weights = shared_weights([one.stripes for one in held])
    trials = tuple(
        RefinementTrial(
            way,
            float(np.sqrt(np.average(one.stripes[:, 0] ** 2, weights=weights))),
            better_by,
            i == chosen,
        )
        for i, (way, one, better_by) in enumerate(zip(WAYS, held, gains, strict=True))
    )
    fit = fits[chosen] if chosen == len(fits) - 1 else allowing_for(fits[chosen], fits[-1], boards)
    return Refinement(fit, chosen > 0, _said(trials), trials)


def _flat(name: str, boards: Sequence[StripedBoard], flatness_mm: float) -> BoardForm:
    points = np.concatenate([board.view.points for board in boards if board.board == name])
    return BoardForm.flat(points, flatness_mm, PRINT)


def _said(trials: Sequence[RefinementTrial]) -> str:
    """Which method was chosen, and by how much each was better than the one before."""
    chosen = next(trial.way for trial in trials if trial.chosen)
    others = "; ".join(
        f"{trial.way}: {trial.gain:+z.1f} standard errors on held-out boards"
        for trial in trials
        if trial.gain is not None
    )
    return f"{chosen} ({others})"


@dataclass(frozen=True, eq=False)
class _HeldOut:
    """What one method left over on held-out boards.

    stripes: distances from the boards, whose motion is removed, (N, 1) mm, in the order of the
        data.
    corners: (M, 2) px, board by board.
    """

    stripes: Array
    corners: Array


def _hold_out(
    fits: Sequence[JointFit[SmoothSheets]], boards: Sequence[StripedBoard], data: BoundaryPoints
) -> list[_HeldOut]:
    """Leave out each board, or one of MOST_FOLDS groups of them, in turn.

    If there are so few boards that the camera needs them all, only their stripes are left out.
    """
    stripes = [np.empty(len(data.index)) for _ in fits]
    corners = [[np.empty((0, 2))] * len(boards) for _ in fits]
    folds = min(len(boards), MOST_FOLDS)
    for number in range(folds):
        held = range(number, len(boards), folds)
        rest = [board for k, board in enumerate(boards) if k not in held]
        if len(rest) < FEWEST_BOARDS:
            rest += [_unlit(boards[k]) for k in held]
        for way, (name, fit) in enumerate(zip(WAYS, fits, strict=True)):
            one = _without(name, fit, rest)
            for k in held:
                off, corners[way][k] = _off_board(one, boards[k], fit)
                stripes[way][data.board == k] = off
    effects = data.board_errors.effects
    cap = CAP * min(float(np.nanmedian(np.abs(values))) for values in stripes)
    still = [
        without_motion(capped(values, cap), effects, data.board)[:, None] for values in stripes
    ]
    return [_HeldOut(s, np.concatenate(c)) for s, c in zip(still, corners, strict=True)]


def _without(
    way: str, fit: JointFit[SmoothSheets], rest: Sequence[StripedBoard]
) -> JointFit[SmoothSheets]:
    """Repeat `fit` from the rest of the boards."""
    poses = [fit.camera_from_board[board.view.shot] for board in rest]
    if way != APART:
        return refine_jointly(
            fit.camera,
            fit.camera_from_board,
            fit.sheets,
            rest,
            fit.forms,
            bent=way == BENT,
            steps=FOLD_STEPS,
        )
    camera = fit_camera(fit.camera, poses, [board.view for board in rest])
    parts = [
        carried(camera.camera, pose, board, k, fit.sheets.direction)
        for k, (pose, board) in enumerate(zip(camera.poses, rest, strict=True))
        if len(board.index)
    ]
    sheets = fit_sheets(fit.sheets, concatenate(parts), most_steps=FOLD_STEPS).sheets
    return replace(fit, camera=camera.camera, sheets=sheets)


def _unlit(board: StripedBoard) -> StripedBoard:
    """The board with its corners alone."""
    return replace(
        board, pixels=board.pixels[:0], index=board.index[:0], sigma_px=board.sigma_px[:0]
    )


def _off_board(
    one: JointFit[SmoothSheets], board: StripedBoard, start: JointFit[SmoothSheets]
) -> tuple[Array, Array]:
    """Held-out errors of one board, whose pose is fitted to its corners.

    (N,) mm: distances of its boundary points, as camera and sheets measure them, from the board.
    (M, 2) px: residuals of its corners.
    """
    form, view = one.forms[board.board], board.view
    really = replace(view, points=form.applied(view.points, form.numbers(view.points)))
    pose, residuals = locate_board(one.camera, really, start.camera_from_board[view.shot])
    rays = one.camera.rays(board.pixels)
    points = rays * one.sheets.depth(rays, board.index)[:, None]
    seen = pose.inverse().apply(points)
    return seen[:, 2] - view.points[0, 2] - form.height(seen[:, :2]), residuals
