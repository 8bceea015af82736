"""Check that the stripes on all boards of a pair are consistent with one projector at rest."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from bodyscan.arrays import Array, Indices
from bodyscan.calibration.boundary_points import BoundaryPoints, select, subsample
from bodyscan.calibration.sheet_fit import fit_pinhole, fit_sheets
from bodyscan.errors import PairFailed
from bodyscan.geometry.bowed_sheets import BowedSheets
from bodyscan.geometry.lens_sheets import LensSheets
from bodyscan.geometry.light_planes import Axis, LightSheets
from bodyscan.geometry.light_sheets import intersect_rays

MAX_MISFIT_PX = 0.4
"""Boards that agree this well are not examined further."""
MIN_GROUP = 3
"""Two boards agree on nearly any light."""


@dataclass(frozen=True, eq=False)
class ProjectorMotion:
    """A split of the boards into two groups, each of which is consistent with one light.

    kept, others: numbers of the boards in each group, in the order of the shots; `others` are a few
        that do not fit or, where the projector `moved`, all that were taken afterwards.
    joint_px, separate_px: RMS misfit of the stripes with one light for all boards, and with one for
        each group.
    """

    kept: Indices
    others: Indices
    joint_px: float
    separate_px: float
    moved: bool = False


def find_projector_motion(
    data: BoundaryPoints, stripes: int, direction: Axis
) -> ProjectorMotion | None:
    """Split the boards into groups with different light; None if all agree or there are fewer than
    three.

    data: its `board` counts in the order of the shots.

    Raises PairFailed if the misfit is larger than a stripe and no split explains it.
    """
    few = subsample(data, 1200)
    boards = np.unique(few.board)
    if len(boards) < 3:
        return None
    joint = _misfit(few, [boards], stripes, direction)
    if joint < MAX_MISFIT_PX:
        return None
    best, separate = None, joint
    for split in _candidate_splits(
        boards, joint, lambda groups: _misfit(few, groups, stripes, direction)
    ):
        if 3.0 * split.separate_px < separate:
            best, separate = split, split.separate_px
        if separate < MAX_MISFIT_PX:
            break
    if best is None and joint > (width := _stripe_width(few)):
        raise PairFailed(
            f"no projector explains the stripes on {len(boards)} boards, nor those on most of them: "
            f"the misfit is {joint:.1f} px, a stripe is {width:.1f} px wide. Possible causes: images "
            "of several shots are mixed up; `stripes` or `direction` is wrong",
            remedy="check that the lit image and the patterns of each shot belong together, and "
            "`stripes` and `direction` in the rig file",
        )
    return best


def board_offsets(data: BoundaryPoints, sheets: LightSheets) -> Array:
    """Compute the offset (B,) mm of each board as the stripes measure it from its pose by corners.

    Median along the board's normal, positive away from the camera.
    """
    rays = data.points / data.points[:, 2:]
    depth = intersect_rays(sheets, rays, data.index.astype(float)).depth
    offset = (depth - data.points[:, 2]) * data.board_errors.facing
    known = np.isfinite(offset)
    offset, board = offset[known], data.board[known]
    return np.array([np.median(offset[board == k]) for k in np.unique(board)], np.float64)


Misfit = Callable[[Sequence[Indices]], float]


def _candidate_splits(boards: Indices, joint: float, misfit: Misfit) -> Iterator[ProjectorMotion]:
    """Yield possible splits, simplest first: without one board, in time, without several.

    Boards are dropped one after another, each time the one without which the others agree best, while
    most boards are left and their agreement still means something.
    """
    kept, min_kept = boards, max(MIN_GROUP, len(boards) // 2 + 1)
    while len(kept) > min_kept or kept is boards:
        separate, dropped = min((misfit([kept[kept != board]]), board) for board in kept)
        first = kept is boards
        kept = kept[kept != dropped]
        yield ProjectorMotion(kept, np.setdiff1d(boards, kept), joint, separate)
        if first and len(boards) > 3:
            yield _split_in_time(boards, joint, misfit)


def _split_in_time(boards: Indices, joint: float, misfit: Misfit) -> ProjectorMotion:
    """Split all boards before a shot from all after it, where the groups agree best.

    If only two boards come first, their agreement means nothing: they are dropped, and the others
    determine the projector.
    """
    cuts = range(2, len(boards) - 1)
    separate, first = min((misfit([boards[:cut], boards[cut:]]), cut) for cut in cuts)
    before, after = boards[:first], boards[first:]
    if first < MIN_GROUP <= len(after):
        return ProjectorMotion(after, before, joint, separate)
    return ProjectorMotion(before, after, joint, separate, moved=True)


def _stripe_width(data: BoundaryPoints) -> float:
    """Estimate the width of a stripe, px: distance of neighbouring boundaries, median over boards."""
    widths = []
    for board in np.unique(data.board):
        rows = data.board == board
        across = np.sum(data.points[rows] * data.per_pixel[rows], axis=1)
        across /= np.sum(data.per_pixel[rows] ** 2, axis=1)
        slope = np.polyfit(data.index[rows].astype(float), across, 1)[0]
        widths.append(abs(float(slope)))
    return float(np.median(widths))


def _misfit(
    data: BoundaryPoints, groups: Sequence[Indices], stripes: int, direction: Axis
) -> float:
    """Compute the RMS over boards of the median distance (px) of stripes from their group's sheets.

    The sheets may bow, so that no kind of projector is mistaken for one that moved.
    """
    medians = []
    for group in groups:
        points = select(data, np.isin(data.board, group))
        pinhole, middle = (
            fit_pinhole(points.points, points.index.astype(float)),
            points.points.mean(0),
        )
        plain = LensSheets.from_matrix(pinhole, middle, stripes, direction)
        fit = fit_sheets(BowedSheets.from_pinhole(plain, 1), points, max_steps=12)
        distance = np.abs(fit.distances_mm) / np.linalg.norm(points.per_pixel, axis=1)
        medians += [float(np.median(distance[points.board == board])) for board in group]
    return float(np.sqrt(np.mean(np.square(medians))))
