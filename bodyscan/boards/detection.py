"""Calibration boards found in an image."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bodyscan.arrays import Bytes
from bodyscan.boards.charuco import detect_markers, locate_charuco
from bodyscan.boards.checkerboard import find_checkerboard
from bodyscan.boards.corners import SightedCorners
from bodyscan.boards.view import BoardView
from bodyscan.rig.board import Board

MIN_CORNERS = 6


def find_boards(image: Bytes, boards: Sequence[Board], *, pair: str, shot: str) -> list[BoardView]:
    """Every board of `boards` that the image (H, W) shows, in their order; none: an empty list.

    ChArUco boards may be seen in part (at least 6 corners, not on one line), from either face.
    A plain checkerboard must be seen whole; its views are `turnable` where the print looks the
    same from both ends, and where it has two faces, which cannot be told apart (its corners are
    then numbered as if it showed its front). Raises BadInput for a board that cannot be found.
    """
    views = []
    markers = {
        board.dictionary: detect_markers(image, board)
        for board in boards
        if board.kind == "charuco"
    }
    for board in boards:
        if board.kind == "charuco":
            found = locate_charuco(image, board, markers[board.dictionary])
            turnable = False
        else:
            found = find_checkerboard(image, board)
            turnable = board.faces == 2 or (board.columns + board.rows) % 2 == 0
        if found is not None and _determines_plane(found):
            views.append(BoardView(pair, shot, board.name, found.ids, found.pixels, turnable))
    return views


def _determines_plane(found: SightedCorners) -> bool:
    """At least six corners (four on a board that has no more), not all on one line."""
    if len(found.ids) < min(MIN_CORNERS, found.printed_count):
        return False
    spread = np.linalg.svd(found.pixels - found.pixels.mean(axis=0), compute_uv=False)
    return bool(spread[1] > 2.0)
