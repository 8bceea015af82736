"""A board in one image as the camera's calibration takes it: points of a plane and their pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bodyscan.boards.board import corner_points, corners_per_face
from bodyscan.boards.view import BoardView
from bodyscan.rig.board import Board

Array = NDArray[np.float64]

FEWEST_CORNERS = 8


@dataclass(frozen=True, eq=False)
class PlanarView:
    """One board in one image: points (N, 3) of its frame, all at one z, and pixels (N, 2)."""

    shot: str
    points: Array
    pixels: Array


def planar_view(view: BoardView, board: Board) -> PlanarView:
    """A board view with its corners' places in the board frame."""
    return PlanarView(view.shot, corner_points(board)[view.corner_ids], view.pixels)


def usable(view: BoardView, board: Board) -> bool:
    """Enough corners, not all along one line of the board."""
    grid = view.corner_ids % corners_per_face(board)
    columns, rows = grid % (board.columns - 1), grid // (board.columns - 1)
    return len(grid) >= FEWEST_CORNERS and len(set(columns)) >= 3 and len(set(rows)) >= 3
