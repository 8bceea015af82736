"""Whether all boards of a pair saw the same light: a projector must not move between shots."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from bodyscan.arrays import Array, Indices
from bodyscan.calibration.boundary_points import (
    BoundaryPoints,
    bin_points,
    board_errors,
    select,
    subsample,
)
from bodyscan.calibration.pinhole_projector import fit_pinhole
from bodyscan.calibration.sheet_fit import fit_sheets
from bodyscan.geometry.bowed_sheets import BowedSheets
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.light_planes import Axis, LightSheets
from bodyscan.geometry.ray_depths import intersect_rays

FEW_POINTS = 1200
STEPS = 12
SUSPECT_PX = 0.4
"""Boards that agree this well are not looked at any further."""
CLEARLY = 3.0
"""Boards are told apart if that makes them agree so many times better."""


@dataclass(frozen=True, eq=False)
class ProjectorMotion:
    """Boards, told apart so that each group agrees on the light.

    kept, others: numbers of the boards in two groups, in the order of the shots; `others` is one
    board that fits none, or all that were taken after the projector moved.  together_px, apart_px:
    how well the stripes of all boards fit one light, and those of each group theirs.
    """

    kept: Indices
    others: Indices
    together_px: float
    apart_px: float

    @property
    def one_board(self) -> bool:
        """A single shot fails to fit, so that the rest can be used."""
        return len(self.others) == 1


def find_projector_motion(
    data: BoundaryPoints, camera: Camera, stripes: int, direction: Axis
) -> ProjectorMotion | None:
    """None if all boards agree, or are fewer than three. `data.board` counts in the order of shots."""
    few = subsample(bin_points(data, camera, direction), FEW_POINTS)
    boards = np.unique(few.board)
    if len(boards) < 3:
        return None
    together = _misfit(few, [boards], stripes, direction)
    if together < SUSPECT_PX:
        return None
    best = min(
        (
            ProjectorMotion(kept, others, together, _misfit(few, groups, stripes, direction))
            for kept, others, groups in _partitions(boards)
        ),
        key=lambda tried: tried.apart_px,
    )
    return best if CLEARLY * best.apart_px < together else None


def board_offsets(data: BoundaryPoints, sheets: LightSheets) -> Array:
    """(B,) mm: how far from its place, by the corners of all cameras, each board is measured by the
    stripes: median along its normal, positive away from the camera."""
    rays = data.points / data.points[:, 2:]
    depth = intersect_rays(sheets, rays, data.index.astype(float)).depth
    off = (depth - data.points[:, 2]) * board_errors(data).facing
    known = np.isfinite(off)
    off, board = off[known], data.board[known]
    return np.array([np.median(off[board == k]) for k in np.unique(board)], np.float64)


def _partitions(boards: Indices) -> Iterator[tuple[Indices, Indices, list[Indices]]]:
    """Each board against the rest, then all before against all after; the groups to fit."""
    for board in boards:
        kept = boards[boards != board]
        yield kept, boards[boards == board], [kept]
    for first in range(2, len(boards) - 1):
        yield boards[:first], boards[first:], [boards[:first], boards[first:]]


def _misfit(data: BoundaryPoints, groups: list[Indices], stripes: int, direction: Axis) -> float:
    """Root mean square over boards of the median distance (px) of its stripes from its group's
    sheets. Sheets that may bow, so that no kind of projector is taken for one that moved."""
    medians = []
    for group in groups:
        own = select(data, np.isin(data.board, group))
        plain = fit_pinhole(own.points, own.index.astype(float)).sheets(
            own.points, stripes, direction
        )
        fit = fit_sheets(BowedSheets.of_pinhole(plain, 1), own, most_steps=STEPS)
        off = np.abs(fit.distances_mm) / np.linalg.norm(own.per_pixel, axis=1)
        medians += [float(np.median(off[own.board == board])) for board in group]
    return float(np.sqrt(np.mean(np.square(medians))))
