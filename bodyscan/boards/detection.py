"""Calibration boards found in an image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from bodyscan.arrays import Bytes
from bodyscan.boards.appearance import AS_PRINTED, OTHERWISE, Appearance
from bodyscan.boards.aprilgrid import find_aprilgrid
from bodyscan.boards.charuco import (
    Markers,
    detect_markers,
    locate_charuco,
    markers_concerned,
    place_markers,
)
from bodyscan.boards.checkerboard import find_checkerboard
from bodyscan.boards.corners import SightedCorners
from bodyscan.boards.view import BoardView
from bodyscan.rig.board import Board

MIN_CORNERS = 6
Seen = dict[tuple[str, Appearance, bool], Markers]
"""Markers found, once per dictionary, appearance, and quick or thorough search."""


def find_boards(image: Bytes, boards: Sequence[Board], *, pair: str, shot: str) -> list[BoardView]:
    """Every board of `boards` that the image (H, W) shows, in their order; none: an empty list.

    ChArUco boards and grids of AprilTags may be seen in part (at least 6 corners, not on one line),
    from either face, and be printed white on black, mirrored, or in OpenCV's other layout: the
    view's appearance says so.
    A plain checkerboard must be seen whole. Its views are `turnable` if the print looks the same
    from both ends, and if it has two faces, which cannot be told apart (its corners are then
    numbered as if it showed its front).

    Raises BadInput for a board that cannot be found.
    """
    views = []
    seen: Seen = {}
    first: dict[str, int] = {}
    for board in boards:
        first[board.dictionary] = max(markers_concerned(board), first.get(board.dictionary, 0))
    for board in boards:
        if board.kind != "checkerboard":
            found = _find_marked(image, board, seen, first)
        else:
            found = find_checkerboard(image, board)
        if found is not None and _determines_plane(found):
            turnable = board.looks_same_turned
            views.append(
                BoardView(
                    pair, shot, board.name, found.ids, found.pixels, turnable, found.appearance
                )
            )
    return views


def _find_marked(
    image: Bytes,
    board: Board,
    seen: Seen,
    first: dict[str, int],
) -> SightedCorners | None:
    """Find a board as printed, or else white on black, or mirrored.

    first: number of the markers, by dictionary, that are printed at all.
    """
    for appearance in (AS_PRINTED, *OTHERWISE):
        picture = appearance.as_printed(image)
        if board.kind == "aprilgrid":
            found = find_aprilgrid(picture, board, thorough=appearance == AS_PRINTED)
        else:
            found = _find_charuco(picture, board, appearance, seen, first[board.dictionary])
        if found is not None and _determines_plane(found):
            pixels = appearance.in_image(found.pixels, image.shape[1])
            shown = replace(
                found.appearance, inverted=appearance.inverted, mirrored=appearance.mirrored
            )
            return replace(found, pixels=pixels, appearance=shown)
    return None


def _find_charuco(
    picture: Bytes, board: Board, appearance: Appearance, seen: Seen, first: int
) -> SightedCorners | None:
    """Find a board by a quick search, followed by a thorough one if markers are missing."""

    def look(quick: bool) -> Markers:
        key = board.dictionary, appearance, quick
        if key not in seen:
            seen[key] = detect_markers(picture, board, first=first, quick=quick)
        return seen[key]

    if appearance == AS_PRINTED:  # true of nearly all
        markers = look(quick=True)
        placed = place_markers(board, markers)
        if placed is not None and placed.believed and placed.all_seen(picture.shape):
            return locate_charuco(picture, board, markers, placed)
    markers = look(quick=False)
    return locate_charuco(picture, board, markers, place_markers(board, markers))


def _determines_plane(found: SightedCorners) -> bool:
    """Whether there are six corners (four on a board that has no more), not all on one line."""
    if len(found.ids) < min(MIN_CORNERS, found.printed_count):
        return False
    spread = np.linalg.svd(found.pixels - found.pixels.mean(axis=0), compute_uv=False)
    return bool(spread[1] > 2.0)
