"""ChArUco boards: markers give rough corner positions, the corners' saddles exact ones."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from bodyscan.arrays import Array, Bytes, Indices, Mask
from bodyscan.boards import board_layout
from bodyscan.boards.appearance import Appearance
from bodyscan.boards.board_map import BoardMap, fit_board_map
from bodyscan.boards.corners import SightedCorners, refine_corners
from bodyscan.errors import BadInput
from bodyscan.rig.board import Board

MIN_CORNERS = 4
LEAST_AGREEING = 0.6
MIN_CORNERS_FOR_LENS = 12
RANSAC_SHARE_OF_SQUARE = 0.15
ROUNDS = 4
QUICK_WINDOW_PX = 13
"""Window of the threshold for markers: the middle one of OpenCV's three. Alone it finds all markers
of nine images in ten in less than half the time."""


@dataclass(frozen=True, eq=False)
class Markers:
    """ids: (M,) int64. corners: (M, 4, 2) float64 px, from each marker's top left, clockwise."""

    ids: Indices
    corners: Array


def detect_markers(
    image: Bytes,
    board: Board,
    *,
    border_bits: int = 1,
    first: int | None = None,
    quick: bool = False,
) -> Markers:
    """Detect markers of the board's dictionary in the image (H, W).

    border_bits: width of their black rim in bits.
    first: look only for so many, from the dictionary's first. Telling which of a thousand markers a
        square shows takes most of the time.
    quick: use one threshold (`QUICK_WINDOW_PX`), which may miss some.
    """
    parameters = _parameters()
    if quick:
        parameters.adaptiveThreshWinSizeMin = QUICK_WINDOW_PX
        parameters.adaptiveThreshWinSizeMax = QUICK_WINDOW_PX
    parameters.markerBorderBits = border_bits
    dictionary = board_layout.marker_dictionary(board)
    some = np.ascontiguousarray(dictionary.bytesList[:first])
    few = cv2.aruco.Dictionary(some, dictionary.markerSize, dictionary.maxCorrectionBits)
    detector = cv2.aruco.ArucoDetector(few, parameters)
    corners, ids, _ = detector.detectMarkers(image)
    if ids is None or len(ids) == 0:
        return Markers(np.empty(0, np.int64), np.empty((0, 4, 2)))
    corners = np.asarray([np.reshape(corner, (4, 2)) for corner in corners], float)
    return Markers(np.asarray(ids, np.int64).ravel(), corners)


def markers_concerned(board: Board) -> int:
    """How many of its dictionary's first markers to look for: a board's own and those with which it
    would go on; of a board with two faces, whose back has the next ones, only its own."""
    if board.faces == 2:
        return board.first_marker + board.marker_count
    longer = board.model_copy(update={"rows": board.rows + 2})
    return board.first_marker + longer.marker_count + board.columns


def _parameters() -> cv2.aruco.DetectorParameters:
    parameters = cv2.aruco.DetectorParameters()
    parameters.minMarkerPerimeterRate = 0.01
    return parameters


@dataclass(frozen=True, eq=False)
class PlacedMarkers:
    """Markers that agree on where one face of a board, as described here, appears.

    printed: (K, 4, 2) mm, of those that agree.
    seen: how many of the face's markers were seen.
    """

    board: Board
    face: int
    board_map: BoardMap
    printed: Array
    seen: int

    @property
    def agreeing(self) -> int:
        return len(self.printed)

    @property
    def believed(self) -> bool:
        """Whether most markers agree: on a board with other
        columns or rows only some rows seem to."""
        return self.agreeing > LEAST_AGREEING * self.seen

    def all_seen(self, shape: tuple[int, ...]) -> bool:
        """Whether all markers that lie wholly within an image (H, W) were seen."""
        _, printed = board_layout.marker_corners(self.board, self.face)
        pixels, last = self.board_map.apply(printed), np.array(shape[::-1]) - 1
        inside = np.all((pixels >= 0.0) & (pixels <= last), axis=(1, 2))
        return int(inside.sum()) <= self.agreeing


def locate_charuco(
    image: Bytes, board: Board, markers: Markers, placed: PlacedMarkers | None
) -> SightedCorners | None:
    """The board's corners beside the markers seen, for the face and layout on which most markers
    agree (`place_markers`); `other_layout` says which layout that is."""
    if placed is None or not placed.believed:
        return None
    nearby = _corners_beside(board, placed.printed.mean(axis=1))
    if len(nearby) < MIN_CORNERS:
        return None
    pixels, good = _refine(image, board, placed.board_map, nearby, placed.printed)
    count = board_layout.corners_per_face(board)
    ids = nearby[good] + placed.face * count
    appearance = Appearance(
        other_layout=placed.board.legacy_layout != board.legacy_layout,
        goes_on=_goes_on(placed, markers),
    )
    return SightedCorners(ids, pixels[good], count, appearance)


def _goes_on(placed: PlacedMarkers, markers: Markers) -> bool:
    """Whether markers lie where a board of more rows would have its next ones."""
    if placed.board.faces == 2:
        return False  # the back's markers have the next numbers
    longer = placed.board.model_copy(update={"rows": placed.board.rows + 2})
    ends = placed.board.first_marker + board_layout.markers_per_face(placed.board)
    if not np.any((markers.ids >= ends) & (markers.ids < ends + placed.board.columns)):
        return False
    try:
        more = place_markers(longer, markers)
    except BadInput:  # the dictionary has no more
        return False
    return more is not None and more.agreeing > placed.agreeing


def place_markers(board: Board, markers: Markers) -> PlacedMarkers | None:
    """Place the board by its markers: the face and the layout on which most agree."""
    found = [
        _place_face(described, face, markers)
        for described in _layouts(board)
        for face in range(board.faces)
    ]
    return max((one for one in found if one), key=lambda one: one.agreeing, default=None)


def _layouts(board: Board) -> list[Board]:
    """The board as described and, where OpenCV before 4.6
    printed it differently, in that layout."""
    if board.rows % 2:
        return [board]
    return [board, board.model_copy(update={"legacy_layout": not board.legacy_layout})]


def _place_face(board: Board, face: int, markers: Markers) -> PlacedMarkers | None:
    face_ids, printed = board_layout.marker_corners(board, face)
    _, seen, of_face = np.intersect1d(markers.ids, face_ids, return_indices=True)
    if len(seen) < 2:
        return None
    fit = fit_markers(printed[of_face], markers.corners[seen], board)
    if fit is None:
        return None
    board_map, inliers = fit
    return PlacedMarkers(board, face, board_map, printed[of_face[inliers]], len(seen))


def _refine(
    image: Bytes,
    board: Board,
    board_map: BoardMap,
    corner_ids: Indices,
    markers: Array,
) -> tuple[Array, Mask]:
    """Refine corners where the markers predict them; then those not found where the corners found,
    which are more accurate than markers, predict them."""
    points = board_layout.printed_corners(board)[corner_ids]
    gap = (1.0 - (board.marker_mm or 0.0) / board.square_mm) / 2.0
    marked = np.floor(markers[0].mean(axis=0) / board.square_mm).astype(int).sum()
    row, column = np.divmod(corner_ids, board.columns - 1)
    bright_diagonal = (row + column + marked) % 2 == 0

    def refine(at: BoardMap) -> tuple[Array, Mask]:
        along = board.square_mm * at.jacobian(points)
        return refine_corners(image, at.apply(points), along, bright_diagonal, marker_gap=gap)

    pixels, good = refine(board_map)
    if MIN_CORNERS_FOR_LENS <= good.sum() < len(good):
        again, good_again = refine(fit_board_map(points[good], pixels[good]))
        pixels = np.where(good[:, None], pixels, again)
        good = good | good_again
    return pixels, good


def fit_markers(printed: Array, corners: Array, board: Board) -> tuple[BoardMap, Mask] | None:
    """Where the print appears, and which markers (M,) agree on it; None if no two do.

    A homography selects those that agree; a few rounds follow a lens that bends the board's far
    parts away from it.
    """
    size = np.median(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1))
    tolerance = max(2.0, RANSAC_SHARE_OF_SQUARE * size * board.square_mm / (board.marker_mm or 1))
    points, pixels = printed.reshape(-1, 2), corners.reshape(-1, 2)
    _, mask = cv2.findHomography(points, pixels, cv2.RANSAC, tolerance)
    if mask is None:
        return None
    agree = mask.reshape(-1, 4).all(axis=1)
    for _ in range(ROUNDS):
        if agree.sum() < 2:
            return None
        board_map = fit_board_map(printed[agree].reshape(-1, 2), corners[agree].reshape(-1, 2))
        error = np.linalg.norm(board_map.apply(printed) - corners, axis=-1)
        agree = (error < tolerance).all(axis=1)
    return (board_map, agree) if agree.sum() >= 2 else None


def _corners_beside(board: Board, centres: Array) -> Indices:
    """Ids, on one face, of the inner corners that touch squares with these centres (M, 2) mm."""
    square = np.floor(centres / board.square_mm).astype(int)
    column = (square[:, 0, None] + np.array([-1, 0, -1, 0])).ravel()
    row = (square[:, 1, None] + np.array([-1, -1, 0, 0])).ravel()
    inside = (column >= 0) & (column < board.columns - 1) & (row >= 0) & (row < board.rows - 1)
    return np.unique(row[inside] * (board.columns - 1) + column[inside]).astype(np.int64)
