"""Whether the boards are what the rig file says: found at all, and of a size that fits the rig."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations

import numpy as np

from bodyscan.boards.board_layout import corners_per_face
from bodyscan.boards.view import BoardView
from bodyscan.errors import FailedWork
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.rig.board import Board
from bodyscan.rig.rig import Rig

SELDOM = 0.5
"""Boards of which fewer corners are found in the usual view are doubted, if no pose fits either."""
OTHER_SIZE, REFUSED_SIZE = 0.03, 0.10
"""Of distances between cameras as a tape measures them. A girth is as wrong: 27 mm of 900 at 3 %."""
LEAST_APART_MM = 100.0


def describe_board(board: Board) -> str:
    """The board as the rig file has it, for a message."""
    marker = f", markers of {board.marker_mm:g} mm, {board.dictionary}" if board.marker_mm else ""
    return (
        f"board {board.name} ({board.kind}, {board.columns} columns x {board.rows} rows of squares "
        f"of {board.square_mm:g} mm{marker})"
    )


def boards_not_found(rig: Rig, views: Sequence[BoardView], images: int) -> list[str]:
    """A line for each board that none of the images shows as the rig file describes it."""
    seen = {view.board for view in views}
    return [
        f"{describe_board(board)} was found in none of {images} images: check it against the board "
        "itself: kind, columns and rows (they count squares, not corners)"
        + (", dictionary, and square_mm against marker_mm" if board.marker_mm else "")
        for board in rig.boards
        if board.name not in seen and images
    ]


def describe_findings(rig: Rig, views: Sequence[BoardView], images: int) -> str:
    """For when no camera could be calibrated: how much of each board was seen, and what to check."""
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


def size_ratio(rig: Rig, rig_from_camera: Mapping[str, RigidTransform]) -> float | None:
    """How many times as far apart the cameras stand as their nominal places; None where fewer than
    two of these are known."""
    nominal = {p.name: np.array(p.nominal.position_mm) for p in rig.pairs if p.nominal}
    ratios = [
        float(
            np.linalg.norm(rig_from_camera[a].translation - rig_from_camera[b].translation)
            / np.linalg.norm(nominal[a] - nominal[b])
        )
        for a, b in combinations(sorted(set(nominal) & set(rig_from_camera)), 2)
        if np.linalg.norm(nominal[a] - nominal[b]) > LEAST_APART_MM
    ]
    return float(np.median(ratios)) if ratios else None


def check_board_size(rig: Rig, rig_from_camera: Mapping[str, RigidTransform]) -> list[str]:
    """A line if the cameras stand farther apart, or nearer, than they are meant to: all lengths of a
    rig come from the boards' squares. Raises FailedWork where no tape measure errs so far."""
    ratio = size_ratio(rig, rig_from_camera)
    if ratio is None or abs(ratio - 1.0) <= OTHER_SIZE:
        return []
    boards = ", ".join(f"{board.name}: {board.square_mm:g}" for board in rig.boards)
    said = f"the cameras stand {ratio:.3f} times as far apart as their nominal poses"
    remedy = (
        f"square_mm may be wrong in the rig file ({boards}; {rig.boards[0].square_mm / ratio:.2f} "
        "would fit)"
    )
    if abs(ratio - 1.0) > REFUSED_SIZE:
        raise FailedWork(
            said,
            where=f"rig {rig.name}",
            remedy=f"{remedy}; or correct `nominal`, or leave it out",
        )
    return [f"{said}: {remedy}"]
