"""Plain checkerboards: several detectors in turn, each judged by whether its corners make a board.

Convention: where columns and rows differ in parity the print looks different from its two ends,
and its first square (0, 0) is BLACK, as OpenCV prints it; that settles the numbering.
"""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from bodyscan.capture import boards
from bodyscan.capture.board_map import fit_board_map
from bodyscan.capture.corners import SightedCorners, refine_corners
from bodyscan.capture.rig import Board
from bodyscan.errors import BadInput

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

CONSISTENT_PX = 1.0
MIN_SHARE_OF_CORNERS = 0.8


def find_checkerboard(image: Image, board: Board) -> SightedCorners | None:
    """All inner corners of a checkerboard seen whole, numbered by the convention above."""
    _refuse_square(board)
    printed = boards.corner_points(board.model_copy(update={"faces": 1}))[:, :2]
    row, column = np.divmod(np.arange(len(printed)), board.columns - 1)
    even = (row + column) % 2 == 0
    for candidate in _candidates(image, board):
        pixels, first_is_black = _numbered_as_printed(image, board, candidate, printed)
        board_map = fit_board_map(printed, pixels)
        error = board_map.apply(printed) - pixels
        if not np.sqrt(np.mean(np.sum(error**2, axis=-1))) < CONSISTENT_PX:
            continue
        along = board.square_mm * board_map.jacobian(printed)
        refined, good = refine_corners(image, pixels, along, even != first_is_black)
        if good.mean() >= MIN_SHARE_OF_CORNERS:
            ids = np.flatnonzero(good).astype(np.int64)
            return SightedCorners(ids, refined[good], len(printed))
    return None


def _refuse_square(board: Board) -> None:
    if board.columns == board.rows:
        raise BadInput(
            "a plain checkerboard with as many columns as rows cannot be told from itself turned "
            "by a quarter",
            where=f"board {board.name}",
            remedy="use a board whose columns and rows differ, or a charuco board",
        )


def _candidates(image: Image, board: Board) -> Iterator[Array]:
    """Corner sets (N, 2) px that the detectors offer, quickest first."""
    size = (board.columns - 1, board.rows - 1)
    for detect in (_classic, _sector_based):
        corners = detect(image, size)
        if corners is not None:
            yield corners


def _classic(image: Image, size: tuple[int, int]) -> Array | None:
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_FAST_CHECK
    found, corners = cv2.findChessboardCorners(image, size, flags=flags)
    return np.asarray(corners, float).reshape(-1, 2) if found else None


def _sector_based(image: Image, size: tuple[int, int]) -> Array | None:
    found, corners = cv2.findChessboardCornersSB(image, size, flags=cv2.CALIB_CB_ACCURACY)
    return np.asarray(corners, float).reshape(-1, 2) if found else None


def _numbered_as_printed(
    image: Image, board: Board, corners: Array, printed: Array
) -> tuple[Array, bool]:
    """Corners (N, 2) in the print's order, and whether its first square is black.

    Never mirrored; from the end where the first square is black if the other end has it white.
    """
    grid = corners.reshape(board.rows - 1, board.columns - 1, 2)
    across = (grid[:, -1] - grid[:, 0]).mean(axis=0)
    down = (grid[-1] - grid[0]).mean(axis=0)
    if across[0] * down[1] - across[1] * down[0] < 0:
        grid = grid[:, ::-1]
    pixels = grid.reshape(-1, 2)
    first_is_black = _first_is_black(image, board, pixels, printed)
    if (board.columns + board.rows) % 2 and not first_is_black:
        pixels, first_is_black = pixels[::-1], True
    return np.ascontiguousarray(pixels), first_is_black


def _first_is_black(image: Image, board: Board, pixels: Array, printed: Array) -> bool:
    """Whether the squares with an even sum of column and row are darker than the others.

    Judged by the middles of all squares between inner corners, so that light across the board
    does not matter.
    """
    board_map = fit_board_map(printed, pixels)
    column, row = np.meshgrid(np.arange(1, board.columns - 1), np.arange(1, board.rows - 1))
    middle = board.square_mm * (np.stack([column.ravel(), row.ravel()], axis=-1) + 0.5)
    where = board_map.apply(middle).astype(np.float32)
    grey = cv2.remap(image, where[:, None], None, cv2.INTER_LINEAR).ravel().astype(float)
    even = (column.ravel() + row.ravel()) % 2 == 0
    return bool(grey[even].mean() < grey[~even].mean())
