"""Printed boards against OpenCV's own drawing, and how they go wrong."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from bodyscan.errors import BadInput
from bodyscan.rig.board import Board
from bodyscan.simulation.board import make_board, make_print
from bodyscan.simulation.settings import BoardMaking

CHARUCO = Board(
    name="b", kind="charuco", columns=6, rows=4, square_mm=60, marker_mm=45, margin_mm=10,
    faces=2, thickness_mm=5, first_marker=7, dictionary="DICT_4X4_1000",
)  # fmt: skip
PLAIN = Board(name="p", columns=5, rows=4, square_mm=20, margin_mm=5)
MAKING = BoardMaking()


def drawn(board: Board, face: int) -> np.ndarray:
    """OpenCV's print, 4 px a mm."""
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    count = board.columns * board.rows // 2
    ids = np.arange(count) + board.first_marker + face * count
    size = (board.columns, board.rows)
    target = cv2.aruco.CharucoBoard(size, board.square_mm, board.marker_mm or 0, dictionary, ids)
    target.setLegacyPattern(board.legacy_layout)
    return target.generateImage((board.columns * 240, board.rows * 240), marginSize=0) < 128


@pytest.mark.parametrize("legacy", [False, True])
@pytest.mark.parametrize("face", [0, 1])
def test_charuco_is_as_opencv_draws_it(legacy: bool, face: int) -> None:
    board = CHARUCO.model_copy(update={"legacy_layout": legacy})
    image = drawn(board, face)
    v, u = np.indices(image.shape)
    places = np.stack([(u.ravel() + 0.5) / 4, (v.ravel() + 0.5) / 4], axis=1).astype(np.float32)
    dark = make_print(board, face, MAKING).albedo(places).reshape(image.shape) < 0.4
    # OpenCV rounds the markers' modules (7.5 mm) to whole px: only edges may differ
    differs = cv2.erode((dark != image).astype(np.uint8), np.ones((3, 3), np.uint8))
    assert differs.sum() == 0
    assert (dark == image).mean() > 0.98


def test_a_dictionary_with_too_few_markers_is_refused() -> None:
    board = CHARUCO.model_copy(update={"dictionary": "DICT_4X4_50", "first_marker": 40})
    with pytest.raises(BadInput, match="50 markers"):
        make_board(board, MAKING, np.random.default_rng(0))


def test_a_bowed_board_stands_out_towards_its_front() -> None:
    made = make_board(CHARUCO, replace(MAKING, bow_mm=2.0), np.random.default_rng(0))
    front, back = made.surfaces[:2]
    middle = np.linalg.norm(front.vertices[:, :2] - [180, 120], axis=1).argmin()
    assert front.vertices[middle, 2] == pytest.approx(-2.0, abs=1e-9)
    corner = np.linalg.norm(front.vertices[:, :2] - [0, 0], axis=1).argmin()
    assert front.vertices[corner, 2] == pytest.approx(0.0, abs=1e-9)
    assert back.vertices[:, 2].min() == pytest.approx(5.0 - 2.0, abs=1e-9)


def test_print_errors_have_the_size_asked_for() -> None:
    making = replace(MAKING, print_error_mm=0.1)
    board = CHARUCO.model_copy(update={"columns": 30, "rows": 30})
    perfect = make_board(board, MAKING, np.random.default_rng(0)).corners
    errors, steps = [], []
    for seed in range(6):
        made = make_board(board, making, np.random.default_rng(seed))
        error = (made.corners - perfect)[: 29 * 29, :2].reshape(29, 29, 2)
        errors.append(error)
        steps.append(np.diff(error, axis=0).std())
        mesh = made.surfaces[0]
        assert mesh.print_xy is not None
        for corner, place in ((0, [60, 60]), (400, [60 * (400 % 29 + 1), 60 * (400 // 29 + 1)])):
            vertex = np.linalg.norm(mesh.print_xy - place, axis=1).argmin()
            assert mesh.vertices[vertex] == pytest.approx(made.corners[corner], abs=1e-9)
    # six boards of six waves are few: within half
    assert np.std(errors) == pytest.approx(0.1, rel=0.5)
    assert np.mean(steps) / np.std(errors) < 0.5
