"""Describe what an image shows in which a board was not found: markers, or grids of other sizes.

It takes a second or more per image, and is meant for images that ought to show a board.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from typing import NamedTuple

import numpy as np

from bodyscan.arrays import Bytes
from bodyscan.boards.aprilgrid import BORDER_BITS, locate_grid
from bodyscan.boards.charuco import Markers, detect_markers, locate_face
from bodyscan.boards.checkerboard import MIN_SQUARES, find_checkerboard, shows_lattice
from bodyscan.boards.detection import OTHER_APPEARANCES
from bodyscan.boards.view import AS_PRINTED, Appearance
from bodyscan.rig.board import LARGEST_DICTIONARIES, MARKERS_IN, Board

MIN_MARKERS = 4
"""Fewer may be chance: quadrilaterals that happen to read as a marker."""


class Unfound(NamedTuple):
    """What an image shows instead of a board, and whether that is why none shows it as described."""

    text: str
    is_cause: bool = False


def describe_unfound(image: Bytes, board: Board, *, quick: bool = False) -> Unfound:
    """Describe what the image (H, W) shows instead of the board; continues a sentence that names it.

    quick: in a tenth of a second; "" for a board with markers.
    """
    if board.kind == "checkerboard":
        cut = f"not whole, {_describe_lattice(image, board)}" if quick else ""
        return Unfound(cut or _describe_grids(image, board))
    if quick:
        return Unfound("")
    markers, appearance = detect_any(image, board)
    count = f"{len(markers.ids)} markers of {board.dictionary}"
    if len(markers.ids) < MIN_MARKERS:
        return Unfound(count + _describe_other_dictionary(image, board))
    if appearance.inverted:
        count += ", white on black"
    if appearance.mirrored:
        count += ", mirrored"
    first = estimate_first_marker(board, markers)
    if first != board.first_marker:
        return Unfound(f"{count}, which lie as on this board with first_marker {first}", True)
    if _count_agreeing(board, markers):
        return Unfound(f"{count}, with too few sharp corners next to them")
    better = max(_fit_other_sizes(board, markers), default=None)
    if better is None:
        return Unfound(
            f"{count}, which do not lie as on {board.columns} columns x {board.rows} rows. Possible "
            "causes: `columns` and `rows`, or `marker_mm` against `square_mm`, are not the print's"
        )
    agreeing, negative_rows, columns = better
    return Unfound(
        f"{count}; {agreeing} of them lie as on a board of {columns} columns x {-negative_rows} rows, "
        f"not {board.columns} x {board.rows}",
        True,
    )


def detect_any(image: Bytes, board: Board) -> tuple[Markers, Appearance]:
    """Detect all markers of the board's dictionary, in the appearance that shows most of them."""
    every = ((_detect(image, board, look), look) for look in (AS_PRINTED, *OTHER_APPEARANCES))
    return max(every, key=lambda found: len(found[0].ids))


def estimate_first_marker(board: Board, markers: Markers) -> int:
    """Estimate with which first marker most of the markers lie as on the board: the described one
    unless another has at least two more, of equals the nearest: two faces have the same layout."""
    best, found = board.first_marker, _count_agreeing(board, markers)
    middle = int(np.median(markers.ids)) if len(markers.ids) else 0
    firsts = range(max(0, middle - board.marker_count + 1), middle + 1)
    for first in sorted(firsts, key=lambda first: abs(first - board.first_marker)):
        in_range = (markers.ids >= first) & (markers.ids < first + board.marker_count)
        if np.count_nonzero(in_range) < found + 2:
            continue
        agreeing = _count_agreeing(board.model_copy(update={"first_marker": first}), markers)
        if agreeing >= found + 2:
            best, found = first, agreeing
    return best


def _detect(image: Bytes, board: Board, appearance: Appearance) -> Markers:
    """Detect the board's markers with the border width, in bits, that finds most of them."""
    picture = appearance.undo(image)
    rims = BORDER_BITS if board.kind == "aprilgrid" else (1,)
    found = [detect_markers(picture, board, border_bits=bits) for bits in rims]
    return max(found, key=lambda markers: len(markers.ids))


def _count_agreeing(board: Board, markers: Markers) -> int:
    """Count the markers that lie as on this board; 0 if too few to be this board."""
    if board.kind == "aprilgrid":
        tags = locate_grid(board, markers)
        return tags.agreeing if tags else 0
    if board.first_marker + board.marker_count > MARKERS_IN.get(board.dictionary, 0):
        return 0
    position = locate_face(board, markers)
    return position.agreeing if position and position.valid else 0


def _describe_other_dictionary(image: Bytes, board: Board) -> str:
    """Name another dictionary with more markers in the image, if there is one."""
    found = {
        name: len(detect_markers(image, board.model_copy(update={"dictionary": name})).ids)
        for name in LARGEST_DICTIONARIES
        if name != board.dictionary
    }
    name = max(found, key=found.__getitem__)
    return f", but {found[name]} of {name}" if found[name] >= MIN_MARKERS else ""


def _fit_other_sizes(board: Board, markers: Markers) -> Iterator[tuple[int, int, int]]:
    """Yield other board sizes on which markers agree: their number, minus the rows, the columns."""
    near = product(*(range(size - 2, size + 3) for size in (board.columns, board.rows)))
    for columns, rows in [*near, (board.rows, board.columns)]:
        if min(columns, rows) < 3:
            continue
        other = board.model_copy(update={"columns": columns, "rows": rows})
        agreeing = _count_agreeing(other, markers)
        if agreeing:
            # The fewest rows that hold them all: rows below the last marker make no difference.
            yield agreeing, -rows, columns


def _describe_grids(image: Bytes, board: Board) -> str:
    wanted = f"{board.columns - 1} x {board.rows - 1} inner corners"
    if find_checkerboard(255 - image, board, quick=True):
        return f"a grid of {wanted}, but white on black"
    # First the likeliest mistake: corners counted in place of squares.
    for more, taller in ((1, 1), (-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0)):
        columns, rows = board.columns + more, board.rows + taller
        if min(columns, rows) < MIN_SQUARES:
            continue
        other = board.model_copy(update={"columns": columns, "rows": rows})
        if find_checkerboard(image, other, quick=True):
            return (
                f"no grid of {wanted}, but one of {columns - 1} x {rows - 1}: {columns} columns x "
                f"{rows} rows of squares"
            )
    lattice = _describe_lattice(image, board)
    return f"no grid of {wanted}, nor of one more or fewer in either direction, {lattice}"


def _describe_lattice(image: Bytes, board: Board) -> str:
    if shows_lattice(image, (board.columns - 1, board.rows - 1)):
        return "but squares like a board's: some may be cut off, covered, blurred or too dark"
    return "nor anything like a board's squares"
