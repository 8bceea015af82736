"""Grids of AprilTags as Kalibr prints them: tags give rough corner positions, saddles exact ones.

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

from bodyscan.arrays import Array, Bytes, Mask
from bodyscan.boards import board_layout
from bodyscan.boards.board_map import BoardMap, fit_board_map
from bodyscan.boards.charuco import Markers, detect_markers, fit_markers, markers_concerned
from bodyscan.boards.corners import WINDOW_SQUARES, SightedCorners, refine_corners
from bodyscan.rig.board import Board

TRIES = ((1.0, 1), (2.0, 3), (1.0, 3), (0.5, 1), (2.0, 1))
"""Scale of the image, and the width in px by which white is grown there."""
BORDER_BITS = (2, 1)
"""Kalibr's tags have a black rim two bits wide, others one bit."""
ENOUGH_TAGS = 0.5
LEAST_TAGS = 3
LEAST_AGREEING = 0.6
CLEAR = 0.85
"""Share of the rim and of the gap that windows may fill."""
ROUNDS = 3


@dataclass(frozen=True, eq=False)
class PlacedTags:
    """The print's board map, how many tags agree on it, and the width of their rims."""

    board_map: BoardMap
    agreeing: int
    border_bits: int


def find_aprilgrid(image: Bytes, board: Board, *, thorough: bool = True) -> SightedCorners | None:
    """Find the grid's visible corners; it may be seen in part. Not thorough: one scale only."""
    best: PlacedTags | None = None
    for placed in _placings(image, board, TRIES if thorough else TRIES[:1]):
        if best is None or placed.agreeing > best.agreeing:
            best = placed
        if best.agreeing >= ENOUGH_TAGS * board_layout.markers_per_face(board):
            break
    if best is None:
        return None
    pixels, good = _refine(image, board, best)
    ids = np.flatnonzero(good).astype(np.int64)
    return SightedCorners(ids, pixels[good], board_layout.corners_per_face(board))


def _placings(
    image: Bytes, board: Board, tries: tuple[tuple[float, int], ...]
) -> Iterator[PlacedTags]:
    for scale, grown in tries:
        picture = image
        if scale != 1.0:
            how = cv2.INTER_CUBIC if scale > 1.0 else cv2.INTER_AREA
            picture = cv2.resize(image, None, fx=scale, fy=scale, interpolation=how)
        if grown > 1:
            picture = cv2.dilate(picture, np.ones((grown, grown), np.uint8))
        for border_bits in BORDER_BITS:
            first = markers_concerned(board)
            tags = detect_markers(picture, board, border_bits=border_bits, first=first)
            corners = (tags.corners + 0.5) / scale - 0.5
            placed = place_tags(board, Markers(tags.ids, corners), border_bits)
            if placed is not None:
                yield placed


def place_tags(board: Board, tags: Markers, border_bits: int = 2) -> PlacedTags | None:
    """Locate the grid by its tags, whichever way each is rotated in its place, and whether they
    count from the lowest row (Kalibr) or from the highest."""
    ids, printed = board_layout.marker_corners(board)
    rows = printed.reshape(board.rows, board.columns, 4, 2)
    best: PlacedTags | None = None
    _, seen, of_grid = np.intersect1d(tags.ids, ids, return_indices=True)
    if len(seen) < LEAST_TAGS:
        return None
    for order in (rows, rows[::-1]):
        own = order.reshape(-1, 4, 2)[of_grid]
        for turn in range(4):
            fit = fit_markers(np.roll(own, turn, axis=1), tags.corners[seen], board)
            if fit is None:
                continue
            agreeing = int(fit[1].sum())
            if agreeing >= max(LEAST_TAGS, LEAST_AGREEING * len(seen)) and (
                best is None or agreeing > best.agreeing
            ):
                best = PlacedTags(fit[0], agreeing, border_bits)
    return best


def _refine(image: Bytes, board: Board, placed: PlacedTags) -> tuple[Array, Mask]:
    """Refine all corners of the grid at the places that the tags predict; then those not found, at
    the places that the corners found predict."""
    printed = board_layout.printed_corners(board)
    reach = _clear_of_edges(board, placed.border_bits) / WINDOW_SQUARES
    bright_diagonal = _bright_diagonal(board, len(printed))
    pixels, good = np.zeros_like(printed), np.zeros(len(printed), bool)
    board_map = placed.board_map
    for _ in range(ROUNDS):
        along = reach * board_map.jacobian(printed)
        again, found = refine_corners(image, board_map.apply(printed), along, bright_diagonal)
        pixels = np.where((found & ~good)[:, None], again, pixels)
        good = good | found
        if good.all() or good.sum() < 4 * LEAST_TAGS:
            break
        board_map = fit_board_map(printed[good], pixels[good])
    return pixels, good


def _clear_of_edges(board: Board, border_bits: int) -> float:
    """Radius around a corner, mm, free of all edges but its own: of rim, gap and small squares."""
    marker_mm = board.marker_mm or 0.0
    bits = board_layout.marker_dictionary(board).markerSize + 2 * border_bits
    rim = border_bits * marker_mm / bits
    return CLEAR * min(rim, board.square_mm - marker_mm)


def _bright_diagonal(board: Board, count: int) -> Mask:
    """Tags are black, so at their upper left and lower right
    corners the other two squares are white."""
    row, column = np.divmod(np.arange(count), 2 * board.columns)
    return np.asarray((row + column) % 2 == 1)
