"""Find grids of AprilTags as Kalibr prints them: tags predict corners, saddles are measured.

Small black squares between the tags touch their corners, so that each corner is a saddle, as on a
checkerboard. For a detector of black quadrilaterals the same squares join neighbouring tags;
therefore it is run at several scales and with the white areas slightly grown, and a few tags are
enough to place the grid.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from bodyscan.arrays import Bytes
from bodyscan.boards import board_layout
from bodyscan.boards.board_map import BoardMap, refine_predicted
from bodyscan.boards.charuco import Markers, detect_markers, fit_markers
from bodyscan.boards.corners import WINDOW_SQUARES, DetectedCorners
from bodyscan.rig.board import Board

BORDER_BITS = (2, 1)
"""Kalibr's tags have a black rim two bits wide, others one bit."""
MIN_TAGS = 3


@dataclass(frozen=True, eq=False)
class GridPosition:
    """Where the print appears, how many tags agree on that, and the width of their rims in bits."""

    board_map: BoardMap
    agreeing: int
    border_bits: int


def find_aprilgrid(image: Bytes, board: Board, *, thorough: bool = True) -> DetectedCorners | None:
    """Find the grid's visible corners, of the whole grid or a part; thorough: at several scales."""
    best: GridPosition | None = None
    for position in _propose_positions(image, board, thorough):
        if best is None or position.agreeing > best.agreeing:
            best = position
        if best.agreeing >= 0.5 * board.marker_count:
            break
    if best is None:
        return None
    printed = board_layout.compute_printed_corners(board)
    # Other edges near a corner are those of rim, gap and small squares.
    marker_mm = board.marker_mm or 0.0
    bits = board_layout.find_marker_dictionary(board).markerSize + 2 * best.border_bits
    clear_mm = 0.85 * min(best.border_bits * marker_mm / bits, board.square_mm - marker_mm)
    # Tags are black: at their upper left and lower right corners the other two squares are white.
    row, column = np.divmod(np.arange(len(printed)), 2 * board.columns)
    bright_diagonal, reach = np.asarray((row + column) % 2 == 1), clear_mm / WINDOW_SQUARES
    pixels, good = refine_predicted(image, best.board_map, printed, reach, bright_diagonal)
    ids = np.flatnonzero(good).astype(np.int64)
    return DetectedCorners(ids, pixels[good])


def _propose_positions(image: Bytes, board: Board, thorough: bool) -> Iterator[GridPosition]:
    # Scale of the image, and the width in px by which white is grown there.
    tries = ((1.0, 1), (2.0, 3), (1.0, 3), (0.5, 1), (2.0, 1))
    for scale, grown in tries if thorough else tries[:1]:
        picture = image
        if scale != 1.0:
            how = cv2.INTER_CUBIC if scale > 1.0 else cv2.INTER_AREA
            picture = cv2.resize(image, None, fx=scale, fy=scale, interpolation=how)
        if grown > 1:
            picture = cv2.dilate(picture, np.ones((grown, grown), np.uint8))
        for border_bits in BORDER_BITS:
            first = board.first_marker + board.marker_count
            tags = detect_markers(picture, board, border_bits=border_bits, first=first)
            corners = (tags.corners + 0.5) / scale - 0.5
            position = locate_grid(board, Markers(tags.ids, corners), border_bits)
            if position is not None:
                yield position


def locate_grid(board: Board, tags: Markers, border_bits: int = 2) -> GridPosition | None:
    """Locate the grid by its tags; None if too few agree.

    All tags may be rotated by quarter turns, and count from the lowest row (Kalibr) or the highest.
    """
    ids, printed = board_layout.compute_marker_corners(board)
    rows = printed.reshape(board.rows, board.columns, 4, 2)
    found = []
    _, detected, of_grid = np.intersect1d(tags.ids, ids, return_indices=True)
    if len(detected) < MIN_TAGS:
        return None
    for order in (rows, rows[::-1]):
        corners = order.reshape(-1, 4, 2)[of_grid]
        for turn in range(4):
            fit = fit_markers(np.roll(corners, turn, axis=1), tags.corners[detected], board)
            if fit is None:
                continue
            agreeing = int(fit[1].sum())
            if agreeing >= max(MIN_TAGS, 0.6 * len(detected)):
                found.append(GridPosition(fit[0], agreeing, border_bits))
    return max(found, key=lambda position: position.agreeing, default=None)
