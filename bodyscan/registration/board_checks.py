"""Check the boards against the rig file, by how much of them is found."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bodyscan.boards.board_layout import corners_per_face
from bodyscan.boards.view import BoardView
from bodyscan.rig.board import Board
from bodyscan.rig.rig import Rig

SELDOM = 0.5
"""Boards are doubted if fewer of their corners are found in the usual view, and no pose fits."""


def describe_board(board: Board) -> str:
    """The board as the rig file describes it, for a message."""
    marker = f", markers of {board.marker_mm:g} mm, {board.dictionary}" if board.marker_mm else ""
    return (
        f"board {board.name} ({board.kind}, {board.columns} columns x {board.rows} rows of squares "
        f"of {board.square_mm:g} mm{marker})"
    )


def boards_not_found(rig: Rig, views: Sequence[BoardView], images: int) -> list[str]:
    """One line for each board that no image shows as the rig file describes it."""
    seen = {view.board for view in views}
    return [
        f"{describe_board(board)} was found in none of {images} images: check it against the board "
        "itself: kind, columns and rows (they count squares, not corners)"
        + (", dictionary, and square_mm against marker_mm" if board.marker_mm else "")
        for board in rig.boards
        if board.name not in seen and images
    ]


def describe_findings(rig: Rig, views: Sequence[BoardView], images: int) -> str:
    """How much of each board was seen and what to check, for when no camera could be calibrated."""
    lines = boards_not_found(rig, views, images)
    for board in rig.boards:
        own = [
            len(view.pixels) / corners_per_face(board) for view in views if view.board == board.name
        ]
        if own:
            lines.append(
                f"{describe_board(board)} was found in {len(own)} of {images} images, with "
                f"{100 * float(np.median(own)):.0f} % of its corners in the usual one"
                + (
                    ": its columns, rows or square_mm in the rig file may not be those of the board"
                    if np.median(own) < SELDOM
                    else ""
                )
            )
    return "\n  ".join(lines)
