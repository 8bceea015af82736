"""Boards located by the markers that agree, and images in which none was found, described."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest

from bodyscan.arrays import Array, Bytes
from bodyscan.boards import detection_failure
from bodyscan.boards.aprilgrid import locate_grid
from bodyscan.boards.board_layout import compute_marker_corners
from bodyscan.boards.charuco import Markers, fit_markers, locate_face
from bodyscan.boards.detection_failure import describe_unfound
from bodyscan.boards.view import AS_PRINTED, Appearance
from bodyscan.rig.board import Board

BOARD = Board(name="b", kind="charuco", columns=9, rows=8, square_mm=50, marker_mm=40)
IMAGE = np.array([[10, 200]], np.uint8)


def checkered(columns: int, rows: int) -> Bytes:
    """Squares of 24 px, straight on."""
    row, column = np.indices((rows, columns))
    squares = np.kron(((row + column) % 2).astype(np.uint8), np.full((24, 24), 200, np.uint8))
    return np.asarray(cv2.GaussianBlur(np.pad(squares, 40, constant_values=200), (0, 0), 0.9))


def image_of(points: Array, scale: float = 1.0) -> Array:
    """A board that leans back a little."""
    x, y = points[..., 0], points[..., 1]
    away = 1.0 + 2e-4 * x + 1e-4 * y
    return np.asarray(np.stack([300.0 + scale * x, 200.0 + scale * y], axis=-1) / away[..., None])


def shown(board: Board, count: int | None = None, wrong: int = 0) -> Markers:
    """The first markers of a board as printed; the wrong ones lie elsewhere."""
    ids, points = compute_marker_corners(board)
    pixels = image_of(points[..., :2])
    pixels[:wrong] += np.random.default_rng(3).uniform(80.0, 300.0, (wrong, 1, 2))
    return Markers(np.asarray(ids)[:count], pixels[:count])


def changed(**keys: Any) -> Board:
    return BOARD.model_copy(update=keys)


def describe(
    markers: Markers,
    monkeypatch: pytest.MonkeyPatch,
    appearance: Appearance = AS_PRINTED,
    board: Board = BOARD,
) -> str:
    """Describe an image in which these markers are detected in one appearance only."""

    def detect(image: Bytes, of: Board, **_: Any) -> Markers:
        if of.dictionary == board.dictionary and np.array_equal(image, appearance.undo(IMAGE)):
            return markers
        return Markers(np.zeros(0, np.int64), np.zeros((0, 4, 2)))

    monkeypatch.setattr(detection_failure, "detect_markers", detect)
    return describe_unfound(IMAGE, board).text


def test_three_markers_may_be_chance(monkeypatch: pytest.MonkeyPatch) -> None:
    assert describe(shown(BOARD, 3), monkeypatch) == "3 markers of DICT_4X4_1000"
    assert "too few sharp corners" in describe(shown(BOARD, 4), monkeypatch)


def test_a_board_of_other_columns_or_rows_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    text = describe(shown(changed(columns=10)), monkeypatch)
    assert "as on a board of 10 columns x" in text
    assert text.endswith("not 9 x 8")
    text = describe(shown(changed(columns=8, rows=9)), monkeypatch)
    assert "as on a board of 8 columns x 9 rows, not 9 x 8" in text
    text = describe(shown(changed(columns=6)), monkeypatch)
    assert "which do not lie as on 9 columns x 8 rows. Possible causes: " in text
    text = describe(shown(changed(first_marker=3)), monkeypatch)
    assert text.endswith("which lie as on this board with first_marker 3")


def test_markers_where_they_should_be_lack_corners(monkeypatch: pytest.MonkeyPatch) -> None:
    text = describe(shown(BOARD), monkeypatch)
    assert text == ("36 markers of DICT_4X4_1000, with too few sharp corners next to them")
    how = Appearance(inverted=True, mirrored=True)
    assert "36 markers of DICT_4X4_1000, white on black, mirrored" in describe(
        shown(BOARD), monkeypatch, how
    )


@pytest.mark.parametrize(("columns", "rows"), [(8, 7), (10, 7), (9, 6), (9, 8), (8, 8), (10, 6)])
def test_a_checkerboard_of_one_line_more_or_fewer_is_named(columns: int, rows: int) -> None:
    board = Board(name="b", kind="checkerboard", columns=9, rows=7, square_mm=30)
    assert describe_unfound(checkered(columns, rows), board).text == (
        f"no grid of 8 x 6 inner corners, but one of {columns - 1} x {rows - 1}: {columns} columns x "
        f"{rows} rows of squares"
    )


def test_of_the_narrowest_checkerboard_that_was_not_found_it_is_said_what_shows() -> None:
    board = Board(name="b", kind="checkerboard", columns=4, rows=9, square_mm=30)
    assert "but one of 4 x 8: 5 columns x 9 rows" in describe_unfound(checkered(5, 9), board).text
    nothing = describe_unfound(np.full((240, 320), 90, np.uint8), board).text
    assert nothing.endswith(
        "more or fewer in either direction, nor anything like a board's squares"
    )


def test_at_a_glance_squares_that_are_not_whole_are_told_from_none() -> None:
    board = Board(name="b", kind="checkerboard", columns=9, rows=7, square_mm=30)
    cut = describe_unfound(checkered(9, 7)[:, 70:], board, quick=True).text
    assert cut.startswith("not whole, but squares like a board's")
    empty = describe_unfound(np.full((240, 320), 90, np.uint8), board, quick=True).text
    assert empty == "not whole, nor anything like a board's squares"
    assert describe_unfound(IMAGE, BOARD, quick=True).text == ""


def printed() -> Array:
    return np.asarray(compute_marker_corners(BOARD)[1])[..., :2]


def test_markers_off_their_place_do_not_agree() -> None:
    pixels = image_of(printed(), 1.2)
    pixels[17, :, 0] += 10.0  # a sixth of a square, which appears 57 px wide
    fit = fit_markers(printed(), pixels, BOARD)
    assert fit is not None
    assert np.flatnonzero(~fit[1]).tolist() == [17]
    mirrored = pixels[:2].copy()
    mirrored[1] = mirrored[1, ::-1]  # no board shows both so
    assert fit_markers(printed()[:2], mirrored, BOARD) is None


def test_a_board_is_located_by_some_of_its_markers() -> None:
    ids, points = compute_marker_corners(BOARD)
    pixels = image_of(points[..., :2], 1.0)
    some = np.arange(3, 36, 4)
    position = locate_face(BOARD, Markers(np.asarray(ids)[some], pixels[some]))
    assert position is not None
    assert (position.agreeing, position.detected, position.face, position.valid) == (9, 9, 0, True)
    corner = np.array([[200.0, 150.0]])
    np.testing.assert_allclose(position.board_map.apply(corner), image_of(corner, 1.0), atol=0.01)
    one = Markers(np.asarray(ids)[:1], pixels[:1])
    assert locate_face(BOARD, one) is None


TAGS = Board(name="t", kind="aprilgrid", columns=6, rows=5, square_mm=120, marker_mm=90)


def tags(turn: int = 0, *, from_top: bool = False, wrong: int = 0, count: int = 30) -> Markers:
    """As a grid's first tags appear, each turned in its place; the wrong ones lie elsewhere."""
    ids, points = compute_marker_corners(TAGS)
    order = points.reshape(5, 6, 4, 2)
    order = order[::-1] if from_top else order
    pixels = image_of(np.roll(order.reshape(-1, 4, 2), turn, axis=1), 0.5)
    pixels[:wrong] += np.random.default_rng(1).uniform(60.0, 200.0, (wrong, 1, 2))
    return Markers(np.asarray(ids)[:count], pixels[:count])


@pytest.mark.parametrize("turn", range(4))
@pytest.mark.parametrize("from_top", [False, True])
def test_a_grid_is_placed_however_tags_are_turned_and_counted(turn: int, from_top: bool) -> None:
    position = locate_grid(TAGS, tags(turn, from_top=from_top))
    assert position is not None
    assert position.agreeing == 30
    corner = np.array([[200.0, 150.0]])
    np.testing.assert_allclose(position.board_map.apply(corner), image_of(corner, 0.5), atol=0.01)


def test_three_tags_and_six_of_ten_have_to_agree() -> None:
    assert locate_grid(TAGS, tags(count=2)) is None
    position = locate_grid(TAGS, tags(count=3))
    assert position is not None
    assert position.agreeing == 3
    position = locate_grid(TAGS, tags(wrong=11))
    assert position is not None
    assert position.agreeing == 19
    assert locate_grid(TAGS, tags(wrong=13)) is None
