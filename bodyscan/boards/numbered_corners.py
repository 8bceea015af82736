"""Corners of a board found by another program, numbered as ours are."""

from __future__ import annotations

import numpy as np

from bodyscan.arrays import Array
from bodyscan.boards.board_layout import corner_points
from bodyscan.boards.view import BoardView
from bodyscan.errors import CaptureError
from bodyscan.rig.board import Board


def number_corners(
    pixels: Array, board: Board, size: tuple[int, int], *, pair: str, shot: str, where: str
) -> BoardView | None:
    """The view of a board given all its corners row by row, (N, 2) px, NaN where one was not found.

    Rows may run from either side: a board is seen from its front. If a plain board's print looks
    the same turned, the end from which it is numbered is left open. None if there is no corner at
    all.
    size: of the image, px.

    Raises CaptureError if the number of corners differs from the board's, or one is outside the
    image.
    """
    grid_width = board.columns - 1 if board.kind != "aprilgrid" else 2 * board.columns
    count = len(corner_points(board))
    known = np.isfinite(pixels).all(axis=1)
    if not known.any():
        return None
    if len(pixels) != count:
        raise CaptureError(
            f"has {len(pixels)} corners, but board {board.name} has {count}",
            where=where,
            remedy=f"All {grid_width} x {count // grid_width} are listed for every image, row by "
            "row, those not found with level `-`.",
        )
    if np.any((pixels[known] < -0.5) | (pixels[known] > np.array(size) - 0.5)):
        raise CaptureError(
            f"has corners outside of {size[0]} x {size[1]} px",
            where=where,
            remedy="Are these the corners of this camera, in pixels of its whole picture?",
        )
    grid = pixels.reshape(-1, grid_width, 2)
    if _turns_left(grid):
        grid = grid[:, ::-1]
    pixels = grid.reshape(-1, 2)
    ids = np.flatnonzero(np.isfinite(pixels).all(axis=1))
    turnable = board.kind == "checkerboard"
    return BoardView(pair, shot, board.name, ids, np.ascontiguousarray(pixels[ids]), turnable)


def _turns_left(grid: Array) -> bool:
    """Whether (R, C, 2) px of a grid have the opposite handedness to a print's columns and rows."""
    along = np.diff(grid, axis=1)[:-1]
    across = np.diff(grid, axis=0)[:, :-1]
    return bool(np.nansum(along[..., 0] * across[..., 1] - along[..., 1] * across[..., 0]) < 0.0)
