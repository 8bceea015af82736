"""The layout of a calibration board: where its corners and its markers lie.

Board frame (mm): origin at the outer corner of the checkered area's first square, x along the
columns, y along the rows (down, as printed), z away from whoever looks at the front.

The back is a separate print, turned over about the board's vertical axis, so that it looks upright
to whoever walks around the board. A point (xb, yb) of the back print lies at
(columns * square - xb, yb, thickness) in the board frame.
"""

from __future__ import annotations

import cv2
import numpy as np

from bodyscan.arrays import Array, Indices
from bodyscan.rig.board import Board


def compute_corner_grid(board: Board) -> tuple[int, int]:
    """Columns and rows of corners on one face: between squares, or of an aprilgrid's tags."""
    if board.kind == "aprilgrid":
        return 2 * board.columns, 2 * board.rows
    return board.columns - 1, board.rows - 1


def count_corners_per_face(board: Board) -> int:
    """Number of corners of one face."""
    columns, rows = compute_corner_grid(board)
    return columns * rows


def compute_corner_points(board: Board) -> Array:
    """Compute the corners in the board frame, (N, 3) mm, or (2N, 3) for a board with two faces.

    Corner id r * (columns - 1) + c is the crossing of column line c + 1 and row line r + 1; the
    back's corners, numbered likewise on its own print, follow the front's. An aprilgrid has the
    corners of all tags, row by row: id r * 2 * columns + c.
    """
    grid = np.meshgrid(*(_space_corners(board, count) for count in (board.columns, board.rows)))
    x, y = grid[0].ravel(), board.stretch * grid[1].ravel()
    front = np.stack([x, y, np.zeros_like(x)], axis=-1)
    back = np.stack([board.size_mm[0] - x, y, np.full_like(x, board.thickness_mm)], axis=-1)
    return np.concatenate([front, back]) if board.faces == 2 else front


def compute_printed_corners(board: Board) -> Array:
    """Corners (N, 2) mm on the print of one face before it was stretched, x along the columns."""
    return compute_corner_points(board.model_copy(update={"faces": 1, "stretch": 1.0}))[:, :2]


def _space_corners(board: Board, count: int) -> Array:
    """Positions of corners along one side of `count` squares or tags, mm."""
    if board.kind != "aprilgrid":
        return board.square_mm * np.arange(1.0, count)
    gap = (board.square_mm - (board.marker_mm or 0.0)) / 2.0
    starts = board.square_mm * np.arange(count)
    return np.stack([starts + gap, starts + board.square_mm - gap], axis=-1).ravel()


def find_marker_dictionary(board: Board) -> cv2.aruco.Dictionary:
    """Look up OpenCV's dictionary by its name, which a valid board has."""
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))


def compute_marker_corners(board: Board, face: int = 0) -> tuple[Indices, Array]:
    """Marker ids (M,) and their four corners on the face's print, (M, 4, 2) mm.

    Corners run clockwise as printed, from the marker's own top left, as OpenCV's detector gives
    them; for an aprilgrid from the print's top left. Its tags count from the lower left, row by row
    upwards, as Kalibr prints them. The back's ids follow the front's.
    """
    count = board.marker_count // board.faces
    ids = board.first_marker + face * count + np.arange(count)
    if board.kind == "aprilgrid":
        x, y = _space_corners(board, board.columns), _space_corners(board, board.rows)
        columns, rows = np.meshgrid(np.arange(board.columns), np.arange(board.rows)[::-1])
        column, row = columns.ravel(), rows.ravel()
        left, right, top, bottom = x[2 * column], x[2 * column + 1], y[2 * row], y[2 * row + 1]
        tags = np.stack([left, top, right, top, right, bottom, left, bottom], axis=-1)
        return ids, tags.reshape(-1, 4, 2)
    charuco = cv2.aruco.CharucoBoard(
        (board.columns, board.rows),
        board.square_mm,
        board.marker_mm or 0.0,
        find_marker_dictionary(board),
        ids,
    )
    charuco.setLegacyPattern(board.legacy_layout)
    corners = np.asarray(charuco.getObjPoints(), float).reshape(-1, 4, 3)[..., :2]
    return ids, corners
