"""Find calibration boards in an image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from bodyscan.arrays import Bytes
from bodyscan.boards.aprilgrid import find_aprilgrid
from bodyscan.boards.board_layout import count_corners_per_face
from bodyscan.boards.charuco import Markers, detect_markers, locate_charuco, locate_face
from bodyscan.boards.checkerboard import find_checkerboard
from bodyscan.boards.corners import DetectedCorners
from bodyscan.boards.view import AS_PRINTED, Appearance, BoardView
from bodyscan.rig.board import Board

OTHER_APPEARANCES = (
    Appearance(inverted=True),
    Appearance(mirrored=True),
    Appearance(inverted=True, mirrored=True),
)


def find_boards(image: Bytes, boards: Sequence[Board], *, pair: str, shot: str) -> list[BoardView]:
    """Find the boards of `boards` that the image (H, W) shows, in their order.

    ChArUco boards and grids of AprilTags may be seen in part (at least 6 corners, not on one line),
    from either face, and be printed white on black, mirrored, or in OpenCV's other layout: the
    view's appearance says so.
    A plain checkerboard must be seen whole. Its views are `turnable` if the print looks the same
    from both ends, and if it has two faces, which cannot be told apart (its corners are then
    numbered as if it showed its front).

    Raises BadInput for a board that cannot be found.
    """
    views = []
    cache: dict[tuple[str, Appearance], Markers] = {}
    for board in boards:
        if board.kind != "checkerboard":
            same_dictionary = [one for one in boards if one.dictionary == board.dictionary]
            first = max(one.first_marker + one.marker_count for one in same_dictionary)
            found = _find_marked(image, board, cache, first)
        else:
            found = find_checkerboard(image, board)
        if found is not None and _determines_plane(found, board):
            corners = found.ids, found.pixels
            views.append(
                BoardView(pair, shot, board.name, *corners, board.is_ambiguous, found.appearance)
            )
    return views


def _find_marked(
    image: Bytes, board: Board, cache: dict[tuple[str, Appearance], Markers], first: int
) -> DetectedCorners | None:
    """Find a board as printed, or else white on black, or mirrored; see `detect_markers`."""
    for appearance in (AS_PRINTED, *OTHER_APPEARANCES):
        picture = appearance.undo(image)
        if board.kind == "aprilgrid":
            found = find_aprilgrid(picture, board, thorough=appearance == AS_PRINTED)
        else:
            key = board.dictionary, appearance
            if key not in cache:
                cache[key] = detect_markers(picture, board, first=first)
            found = locate_charuco(picture, board, locate_face(board, cache[key]))
        if found is not None and _determines_plane(found, board):
            pixels = appearance.original_pixels(found.pixels, image.shape[1])
            combined = replace(
                found.appearance, inverted=appearance.inverted, mirrored=appearance.mirrored
            )
            return replace(found, pixels=pixels, appearance=combined)
    return None


def _determines_plane(found: DetectedCorners, board: Board) -> bool:
    """Whether there are six corners (four on a board that has no more), not all on one line."""
    if len(found.ids) < min(6, count_corners_per_face(board)):
        return False
    extents = np.linalg.svd(found.pixels - found.pixels.mean(axis=0), compute_uv=False)
    return bool(extents[1] > 2.0)
