"""Compare boards with their description in the rig file, by all views of them together."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from scipy.optimize import minimize_scalar

from bodyscan.boards.board_layout import corner_points, corners_per_face
from bodyscan.boards.board_map import fit_board_map
from bodyscan.boards.view import BoardView
from bodyscan.errors import BadInput
from bodyscan.rig.board import Board
from bodyscan.rig.rig import Rig


def describe_board(board: Board) -> str:
    """The board as the rig file describes it, for a message."""
    marker = f", markers of {board.marker_mm:g} mm, {board.dictionary}" if board.marker_mm else ""
    return (
        f"board {board.name} ({board.kind}, {board.columns} columns x {board.rows} rows of squares "
        f"of {board.square_mm:g} mm{marker})"
    )


def estimate_pitch(board: Board, views: Sequence[BoardView]) -> float:
    """Estimate the square_mm that fits an aprilgrid's corners best, with tags as large as described.

    Whatever homography and lens a view has, it shows the ratio of tag and distance, to a few parts in
    ten thousand. As described if no view has 40 corners, which determine the lens.
    """
    largest = sorted(views, key=lambda view: -len(view.pixels))[:10]
    largest = [view for view in largest if len(view.pixels) >= 40]
    if board.kind != "aprilgrid" or not largest:
        return board.square_mm

    def misfit(square_mm: float) -> float:
        tried = board.model_copy(update={"square_mm": square_mm})
        residuals = []
        for view in largest:
            printed = corner_points(tried)[view.corner_ids, :2]
            residuals.append(fit_board_map(printed, view.pixels).apply(printed) - view.pixels)
        return float(np.median(np.abs(np.concatenate(residuals))))

    side = board.marker_mm or 0.0
    found = minimize_scalar(misfit, bounds=(1.02 * side, 2.0 * side), method="bounded")
    return float(found.x)


def refuse_other_pitch(board: Board, views: Sequence[BoardView]) -> None:
    """Raise BadInput if tags stand 0.3 % otherwise than described: focal lengths err by half of it."""
    pitch = estimate_pitch(board, [view for view in views if view.board == board.name])
    if abs(pitch / board.square_mm - 1.0) > 3e-3:
        side = (board.marker_mm or 0.0) * board.square_mm / pitch
        raise BadInput(
            f"the tags of {board.marker_mm:g} mm stand {pitch:.2f} mm from one another in the images, "
            f"not {board.square_mm:g}",
            where=f"board {board.name}",
            remedy=f"measure both on the print: square_mm {pitch:.2f} would fit marker_mm "
            f"{board.marker_mm:g}, or marker_mm {side:.2f} square_mm {board.square_mm:g}",
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
