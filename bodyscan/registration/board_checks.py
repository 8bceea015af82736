"""Compare boards with their description in the rig file, by all views of them together."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from bodyscan.boards.board_layout import corners_per_face
from bodyscan.boards.view import BoardView
from bodyscan.rig.board import Board
from bodyscan.rig.rig import Rig


def describe_board(board: Board) -> str:
    """The board as the rig file describes it, for a message."""
    marker = f", markers of {board.marker_mm:g} mm, {board.dictionary}" if board.marker_mm else ""
    return (
        f"board {board.name} ({board.kind}, {board.columns} columns x {board.rows} rows of squares "
        f"of {board.square_mm:g} mm{marker})"
    )


def boards_not_found(rig: Rig, views: Sequence[BoardView], images: int) -> list[str]:
    """One line for each board that no image shows as the rig file describes it."""
    found = {view.board for view in views}
    return [
        f"{describe_board(board)} was found in none of {images} images: check it against the board "
        "itself: kind, columns and rows (they count squares, not corners)"
        + (", dictionary, and square_mm against marker_mm" if board.marker_mm else "")
        for board in rig.boards
        if board.name not in found and images
    ]


def describe_findings(rig: Rig, views: Sequence[BoardView], images: int) -> str:
    """How much of each board was seen and what to check, for when no camera could be calibrated."""
    lines = boards_not_found(rig, views, images)
    for board in rig.boards:
        shares = [
            len(view.pixels) / corners_per_face(board) for view in views if view.board == board.name
        ]
        if shares:
            # The description may be wrong if the median view shows less than half of the corners.
            lines.append(
                f"{describe_board(board)} was found in {len(shares)} of {images} images, with "
                f"{100 * float(np.median(shares)):.0f} % of its corners in the median view"
                + (
                    ": its columns, rows or square_mm in the rig file may not be those of the board"
                    if np.median(shares) < 0.5
                    else ""
                )
            )
    return "\n  ".join(lines)


def appearance_notes(rig: Rig, views: Sequence[BoardView]) -> list[str]:
    """One line for each difference between a board and its description in the rig file."""
    return [
        line
        for board in rig.boards
        for line in _notes_of_board(board, [view for view in views if view.board == board.name])
    ]


def _notes_of_board(board: Board, views: Sequence[BoardView]) -> Iterator[str]:
    def where(views: Iterable[BoardView]) -> str:
        pairs = sorted({view.pair for view in views})
        return f"{len(list(views))} views ({', '.join(pairs)})"

    inverted = [view for view in views if view.appearance.inverted]
    mirrored = [view for view in views if view.appearance.mirrored]
    other = [view for view in views if view.appearance.other_layout]
    if inverted:
        yield f"board {board.name} is white on black in {where(inverted)}; used so"
    if mirrored:
        cameras = {view.pair for view in mirrored} != {view.pair for view in views}
        yield (
            f"board {board.name} is mirrored in {where(mirrored)}, as in a mirror or through the "
            "glass it is printed on; used so"
            + (
                ". Other cameras see it as printed: if none looks at it from behind, the pictures "
                "of these are flipped"
                if cameras
                else ""
            )
        )
    if other:
        layout = "false" if board.legacy_layout else "true"
        yield (
            f"board {board.name} has the other of OpenCV's two layouts (legacy_layout: {layout}) in "
            f"{where(other)}; used so"
        )
