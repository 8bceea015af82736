"""Find ChArUco boards: markers predict where corners are, their saddles are measured."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from bodyscan.arrays import Array, Bytes, Indices, Mask
from bodyscan.boards import board_layout
from bodyscan.boards.board_map import BoardMap, fit_board_map, refine_predicted
from bodyscan.boards.corners import DetectedCorners
from bodyscan.boards.view import Appearance
from bodyscan.rig.board import Board


@dataclass(frozen=True, eq=False)
class Markers:
    """ids: (M,) int64. corners: (M, 4, 2) float64 px, from each marker's top left, clockwise."""

    ids: Indices
    corners: Array


def detect_markers(
    image: Bytes, board: Board, *, border_bits: int = 1, first: int | None = None
) -> Markers:
    """Detect markers of the board's dictionary in the image (H, W).

    border_bits: width of their black rim in bits.
    first: look only for so many, from the dictionary's first. Identifying one of a thousand markers
        takes most of the time.
    """
    parameters = cv2.aruco.DetectorParameters()
    parameters.minMarkerPerimeterRate = 0.01
    parameters.markerBorderBits = border_bits
    dictionary = board_layout.find_marker_dictionary(board)
    codes = np.ascontiguousarray(dictionary.bytesList[:first])
    dictionary = cv2.aruco.Dictionary(codes, dictionary.markerSize, dictionary.maxCorrectionBits)
    detector = cv2.aruco.ArucoDetector(dictionary, parameters)
    corners, ids, _ = detector.detectMarkers(image)
    if ids is None or len(ids) == 0:
        return Markers(np.empty(0, np.int64), np.empty((0, 4, 2)))
    corners = np.asarray([np.reshape(corner, (4, 2)) for corner in corners], float)
    return Markers(np.asarray(ids, np.int64).ravel(), corners)


@dataclass(frozen=True, eq=False)
class FacePosition:
    """Where one face of a board appears in an image, by the markers that agree on it."""

    board: Board  # the board, in the layout that fits
    face: int
    board_map: BoardMap
    printed: Array  # (K, 4, 2) mm, corners of the markers that agree
    detected: int  # how many of the face's markers were detected

    @property
    def agreeing(self) -> int:
        return len(self.printed)

    @property
    def valid(self) -> bool:
        """Whether most markers agree; with other columns or rows only those of some rows do."""
        return self.agreeing > 0.6 * self.detected


def locate_charuco(
    image: Bytes, board: Board, position: FacePosition | None
) -> DetectedCorners | None:
    """Find the board's corners next to the detected markers.

    position: from `locate_face`; None if it is None, or most markers disagree with it.
    """
    if position is None or not position.valid:
        return None
    # The inner corners, ids on one face, of the squares with these markers.
    square = np.floor(position.printed.mean(axis=1) / board.square_mm).astype(int)
    column = (square[:, 0, None] + np.array([-1, 0, -1, 0])).ravel()
    row = (square[:, 1, None] + np.array([-1, -1, 0, 0])).ravel()
    inside = (column >= 0) & (column < board.columns - 1) & (row >= 0) & (row < board.rows - 1)
    nearby = np.unique(row[inside] * (board.columns - 1) + column[inside]).astype(np.int64)
    if len(nearby) < 4:
        return None
    gap = (1.0 - (board.marker_mm or 0.0) / board.square_mm) / 2.0
    marked = square[0].sum()
    row, column = np.divmod(nearby, board.columns - 1)
    pixels, good = refine_predicted(
        image,
        position.board_map,
        board_layout.compute_printed_corners(board)[nearby],
        board.square_mm,
        (row + column + marked) % 2 == 0,
        marker_gap=gap,
    )
    ids = nearby[good] + position.face * board_layout.count_corners_per_face(board)
    appearance = Appearance(other_layout=position.board.legacy_layout != board.legacy_layout)
    return DetectedCorners(ids, pixels[good], appearance)


def locate_face(board: Board, markers: Markers) -> FacePosition | None:
    """Locate the face of the board, and the layout, on which most markers agree; None if none."""
    layouts = [board]
    if board.rows % 2 == 0:  # OpenCV before 4.6 printed these differently
        layouts.append(board.model_copy(update={"legacy_layout": not board.legacy_layout}))
    found = [_fit_face(layout, face, markers) for layout in layouts for face in range(board.faces)]
    return max((face for face in found if face), key=lambda face: face.agreeing, default=None)


def _fit_face(board: Board, face: int, markers: Markers) -> FacePosition | None:
    face_ids, printed = board_layout.compute_marker_corners(board, face)
    _, detected, of_face = np.intersect1d(markers.ids, face_ids, return_indices=True)
    if len(detected) < 2:
        return None
    fit = fit_markers(printed[of_face], markers.corners[detected], board)
    if fit is None:
        return None
    board_map, inliers = fit
    return FacePosition(board, face, board_map, printed[of_face[inliers]], len(detected))


def fit_markers(printed: Array, corners: Array, board: Board) -> tuple[BoardMap, Mask] | None:
    """Fit where the print appears to markers (M, 4, 2) mm and px; also return the inliers (M,).

    A homography by RANSAC selects the first inliers; a few rounds follow the lens's distortion
    beyond them. None if no two markers agree.
    """
    size = np.median(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1))
    tolerance = max(2.0, 0.15 * size * board.square_mm / (board.marker_mm or 1))
    points, pixels = printed.reshape(-1, 2), corners.reshape(-1, 2)
    _, mask = cv2.findHomography(points, pixels, cv2.RANSAC, tolerance)
    if mask is None:
        return None
    agree = mask.reshape(-1, 4).all(axis=1)
    for _ in range(4):
        if agree.sum() < 2:
            return None
        board_map = fit_board_map(printed[agree].reshape(-1, 2), corners[agree].reshape(-1, 2))
        error = np.linalg.norm(board_map.apply(printed) - corners, axis=-1)
        agree = (error < tolerance).all(axis=1)
    return (board_map, agree) if agree.sum() >= 2 else None
