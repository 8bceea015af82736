"""What an image shows if a board was not found: markers, grids, and how close they are to the
board.

Slow, a second or more per image: meant for images that ought to show a board.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product

import cv2
import numpy as np

from bodyscan.arrays import Bytes
from bodyscan.boards.appearance import AS_PRINTED, OTHERWISE, Appearance
from bodyscan.boards.aprilgrid import BORDER_BITS, place_tags
from bodyscan.boards.board_layout import marker_corners
from bodyscan.boards.charuco import Markers, detect_markers, place_markers
from bodyscan.boards.checkerboard import FEWEST_SQUARES, find_quickly
from bodyscan.rig.board import LARGEST_DICTIONARIES, MARKERS_IN, Board

FEW_MARKERS = 4
"""Fewer may be chance: quadrilaterals that happen to read as a marker."""
ENOUGH_MARKERS, ENOUGH_SHARE = 8, 0.8
OTHER_SIDE = 0.2
"""Share of a marker's side; unrefined outlines are too small by up to a tenth."""
OTHER_SIZES = (-2, -1, 1, 2)


def describe_unfound(image: Bytes, board: Board) -> str:
    """What the image (H, W) shows instead of the board, in words that follow the board's name."""
    if board.kind == "checkerboard":
        return _describe_grids(image, board)
    return _describe_markers(image, board)


def _describe_markers(image: Bytes, board: Board) -> str:
    most, appearance = max(
        ((_markers(image, board, seen), seen) for seen in (AS_PRINTED, *OTHERWISE)),
        key=lambda found: len(found[0].ids),
    )
    if len(most.ids) < FEW_MARKERS:
        return f"{len(most.ids)} markers of {board.dictionary}{_other_dictionaries(image, board)}"
    said = f"{len(most.ids)} markers of {board.dictionary}"
    if appearance.inverted:
        said += ", white on black"
    if appearance.mirrored:
        said += ", mirrored"
    side = _marker_side(board, most)
    if side is not None and abs(side / (board.marker_mm or 1.0) - 1.0) > OTHER_SIDE:
        return (
            f"{said}, whose sides are about {side / board.square_mm:.2f} of a square's: `marker_mm` is "
            f"about {side:.2g} if `square_mm` is {board.square_mm:g}, not {board.marker_mm:g}"
        )
    if _agreeing(board, most):
        return f"{said}, with too few corners beside them that can be seen sharply"
    better = max(_resized(board, most), default=None)
    if better is None:
        return f"{said}, which do not lie as on {board.columns} columns x {board.rows} rows"
    agreeing, fewest_rows, columns = better
    rows = -fewest_rows
    exchanged = board.model_copy(update={"columns": board.rows, "rows": board.columns})
    if _agreeing(exchanged, most) >= agreeing:
        return (
            f"{said}; {agreeing} of them fit with columns and rows exchanged: {board.rows} columns x "
            f"{board.columns} rows"
        )
    return (
        f"{said}; {agreeing} of them lie as on a board of {columns} columns x {rows} rows, not "
        f"{board.columns} x {board.rows}"
    )


def _markers(image: Bytes, board: Board, appearance: Appearance) -> Markers:
    picture = appearance.as_printed(image)
    rims = BORDER_BITS if board.kind == "aprilgrid" else (1,)
    found = [detect_markers(picture, board, border_bits=bits) for bits in rims]
    return max(found, key=lambda markers: len(markers.ids))


def _agreeing(board: Board, markers: Markers) -> int:
    """How many markers lie as on this board; 0 if too few to be this board."""
    if board.kind == "aprilgrid":
        tags = place_tags(board, markers)
        return tags.agreeing if tags else 0
    if board.first_marker + board.marker_count > MARKERS_IN.get(board.dictionary, 0):
        return 0
    placed = place_markers(board, markers)
    return placed.agreeing if placed and placed.believed else 0


def _marker_side(board: Board, markers: Markers) -> float | None:
    """Side of a marker, mm, from the markers' spacing whatever `marker_mm` says; None if
    unclear."""
    layouts = (board, board.model_copy(update={"legacy_layout": not board.legacy_layout}))
    for described in layouts if board.kind == "charuco" else (board,):
        ids, printed = marker_corners(described)
        _, seen, of_board = np.intersect1d(markers.ids, ids, return_indices=True)
        if len(seen) < ENOUGH_MARKERS:
            continue
        corners = markers.corners[seen]
        middles = printed[of_board].mean(axis=1)[:, :2]
        near = 0.2 * board.square_mm
        homography, inliers = cv2.findHomography(corners.mean(axis=1), middles, cv2.RANSAC, near)
        if homography is None or inliers.mean() < ENOUGH_SHARE:
            continue
        flat = cv2.perspectiveTransform(corners.reshape(-1, 1, 2), homography).reshape(-1, 4, 2)
        sides = np.linalg.norm(flat - np.roll(flat, 1, axis=1), axis=-1)
        return float(np.median(sides[inliers.ravel() > 0]))
    return None


def _other_dictionaries(image: Bytes, board: Board) -> str:
    """Words on another dictionary with more markers in the image, if there is one."""
    found = {
        name: len(detect_markers(image, board.model_copy(update={"dictionary": name})).ids)
        for name in LARGEST_DICTIONARIES
        if name != board.dictionary
    }
    name = max(found, key=found.__getitem__)
    return f", but {found[name]} of {name}" if found[name] >= FEW_MARKERS else ""


def _resized(board: Board, markers: Markers) -> Iterator[tuple[int, int, int]]:
    """Other numbers of columns and rows that most markers fit: how many, minus the rows,
    columns."""
    sizes = [
        (board.columns + more, board.rows + taller)
        for more, taller in product((0, *OTHER_SIZES), repeat=2)
    ]
    for columns, rows in [*sizes, (board.rows, board.columns)]:
        if min(columns, rows) < 3:
            continue
        other = board.model_copy(update={"columns": columns, "rows": rows})
        agreeing = _agreeing(other, markers)
        if agreeing:
            # The fewest rows that hold them all: rows below the last marker make no difference.
            yield agreeing, -rows, columns


def _describe_grids(image: Bytes, board: Board) -> str:
    wanted = f"{board.columns - 1} x {board.rows - 1} inner corners"
    if find_quickly(255 - image, board) is not None:
        return f"a grid of {wanted}, but white on black"
    sizes = [(board.columns, board.rows), (board.columns + 1, board.rows + 1)]
    sizes += [
        (board.columns + more, board.rows + taller)
        for more, taller in product((-1, 0, 1), repeat=2)
        if more or taller
    ]
    for columns, rows in dict.fromkeys(sizes):
        if min(columns, rows) < FEWEST_SQUARES or (columns, rows) == (board.columns, board.rows):
            continue
        other = board.model_copy(update={"columns": columns, "rows": rows})
        if find_quickly(image, other) is not None:
            return (
                f"no grid of {wanted}, but one of {columns - 1} x {rows - 1}: {columns} columns x "
                f"{rows} rows of squares"
            )
    found, _, meta = cv2.findChessboardCornersSBWithMeta(image, (3, 3), cv2.CALIB_CB_LARGER)
    if found and meta is not None and np.size(meta) > 9:
        rows, columns = np.asarray(meta).shape[:2]
        return f"no grid of {wanted}; the largest found has {columns} x {rows}"
    return f"no grid of {wanted}, nor of one more or fewer either way"
