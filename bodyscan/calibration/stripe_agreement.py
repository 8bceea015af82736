"""Check that all boards of a pair saw the same light: its projector must not move between shots."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from bodyscan.arrays import Array, Indices
from bodyscan.calibration.boundary_points import (
    BoundaryPoints,
    select,
    subsample,
)
from bodyscan.calibration.pinhole_projector import fit_pinhole
from bodyscan.calibration.sheet_fit import fit_sheets
from bodyscan.errors import PairFailed
from bodyscan.geometry.bowed_sheets import BowedSheets
from bodyscan.geometry.light_planes import Axis, LightSheets
from bodyscan.geometry.light_sheets import intersect_rays

FEW_POINTS = 1200
STEPS = 12
SUSPECT_PX = 0.4
"""Boards that agree this well are not examined further."""
FEWEST_AGREEING = 3
"""Two boards agree on nearly any light."""
CLEARLY = 3.0
"""Boards are split if that improves their agreement by this factor."""


@dataclass(frozen=True, eq=False)
class ProjectorMotion:
    """A split of the boards into two groups, each of which agrees on the light.

    kept, others: numbers of the boards in each group, in the order of the shots; `others` are a few
        that do not fit or, where the projector `moved`, all that were taken afterwards.
    together_px, apart_px: how well stripes fit one light for all boards, and one for each group.
    """

    kept: Indices
    others: Indices
    together_px: float
    apart_px: float
    moved: bool = False


def find_projector_motion(
    data: BoundaryPoints, stripes: int, direction: Axis
) -> ProjectorMotion | None:
    """Find boards that saw different light; None if all agree or there are fewer than three.

    data: its `board` counts in the order of the shots.

    Raises PairFailed if stripes lie farther off than their width and most boards agree on no light:
    images of different shots are mixed up, or the stripes are not those described.
    """
    few = subsample(data, FEW_POINTS)
    boards = np.unique(few.board)
    if len(boards) < 3:
        return None
    together = _misfit(few, [boards], stripes, direction)
    if together < SUSPECT_PX:
        return None
    best, apart = None, together
    for kept, others, misfit, moved in _told_apart(
        boards, lambda groups: _misfit(few, groups, stripes, direction)
    ):
        if CLEARLY * misfit < apart:
            best, apart = ProjectorMotion(kept, others, together, misfit, moved), misfit
        if apart < SUSPECT_PX:
            break
    if best is not None:
        return best
    width = _stripe_width(few)
    if together > width:
        raise PairFailed(
            f"the stripes of {len(boards)} boards fit no light together, nor do those of most of "
            f"them: they are {together:.1f} px off, a stripe is {width:.1f} px wide",
            remedy="see whether the images of these shots are mixed up (the lit image of one, the "
            "patterns of another), and whether `stripes` and `direction` are right",
        )
    return None


def board_offsets(data: BoundaryPoints, sheets: LightSheets) -> Array:
    """Offsets (B,) mm of boards as measured by the stripes from where corners put them.

    Median along the board's normal, positive away from the camera.
    """
    rays = data.points / data.points[:, 2:]
    depth = intersect_rays(sheets, rays, data.index.astype(float)).depth
    off = (depth - data.points[:, 2]) * data.board_errors.facing
    known = np.isfinite(off)
    off, board = off[known], data.board[known]
    return np.array([np.median(off[board == k]) for k in np.unique(board)], np.float64)


Misfit = Callable[[Sequence[Indices]], float]


def _told_apart(boards: Indices, misfit: Misfit) -> Iterator[tuple[Indices, Indices, float, bool]]:
    """Possible splits, simplest first: kept, others, misfit in px, whether the projector moved."""
    left_out = _left_out(boards, misfit)
    yield next(left_out)
    yield from _before_and_after(boards, misfit)
    yield from left_out


def _left_out(boards: Indices, misfit: Misfit) -> Iterator[tuple[Indices, Indices, float, bool]]:
    """Drop one board after another, each time the one without which the others agree best.

    Stops while most boards are left and their agreement still means something.
    """
    kept, fewest = boards, max(FEWEST_AGREEING, len(boards) // 2 + 1)
    while len(kept) > fewest or kept is boards:
        apart, out = min((misfit([kept[kept != board]]), board) for board in kept)
        kept = kept[kept != out]
        yield kept, np.setdiff1d(boards, kept), apart, False


def _before_and_after(
    boards: Indices, misfit: Misfit
) -> Iterator[tuple[Indices, Indices, float, bool]]:
    """Split all boards before a shot from all after it, where the groups agree best.

    If only two boards come first, their agreement means nothing, and the projector stands where the
    others saw it: the two are left out.
    """
    cuts = range(2, len(boards) - 1)
    if cuts:
        apart, first = min((misfit([boards[:cut], boards[cut:]]), cut) for cut in cuts)
        before, after = boards[:first], boards[first:]
        if first < FEWEST_AGREEING <= len(after):
            yield after, before, apart, False
        else:
            yield before, after, apart, True


def _stripe_width(data: BoundaryPoints) -> float:
    """Width of a stripe, px: distance of neighbouring boundaries, median over the boards."""
    widths = []
    for board in np.unique(data.board):
        own = data.board == board
        across = np.sum(data.points[own] * data.per_pixel[own], axis=1)
        across /= np.sum(data.per_pixel[own] ** 2, axis=1)
        slope = np.polyfit(data.index[own].astype(float), across, 1)[0]
        widths.append(abs(float(slope)))
    return float(np.median(widths))


def _misfit(
    data: BoundaryPoints, groups: Sequence[Indices], stripes: int, direction: Axis
) -> float:
    """RMS over boards of the median distance (px) of a board's stripes from its group's sheets.

    The sheets may bow, so that no kind of projector is mistaken for one that moved.
    """
    medians = []
    for group in groups:
        own = select(data, np.isin(data.board, group))
        plain = fit_pinhole(own.points, own.index.astype(float)).sheets(
            own.points, stripes, direction
        )
        fit = fit_sheets(BowedSheets.from_pinhole(plain, 1), own, most_steps=STEPS)
        off = np.abs(fit.distances_mm) / np.linalg.norm(own.per_pixel, axis=1)
        medians += [float(np.median(off[own.board == board])) for board in group]
    return float(np.sqrt(np.mean(np.square(medians))))
