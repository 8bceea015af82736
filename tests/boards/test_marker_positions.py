"""Locating a board by the markers that agree."""

from __future__ import annotations

import numpy as np
import pytest

from bodyscan.arrays import Array
from bodyscan.boards.aprilgrid import locate_grid
from bodyscan.boards.board_layout import marker_corners
from bodyscan.boards.charuco import Markers, fit_markers, locate_face
from bodyscan.rig.board import Board

BOARD = Board(name="b", kind="charuco", columns=9, rows=8, square_mm=50, marker_mm=40)


def printed() -> Array:
    return np.asarray(marker_corners(BOARD)[1])[..., :2]


def image_of(points: Array, scale: float) -> Array:
    """A board that leans back a little."""
    x, y = points[..., 0], points[..., 1]
    away = 1.0 + 2e-4 * x + 1e-4 * y
    return np.asarray(np.stack([300.0 + scale * x, 200.0 + scale * y], axis=-1) / away[..., None])


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
    ids, points = marker_corners(BOARD)
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
    ids, points = marker_corners(TAGS)
    order = points.reshape(5, 6, 4, 2)
    order = order[::-1] if from_top else order
    pixels = image_of(np.roll(order.reshape(-1, 4, 2), turn, axis=1), 0.5)
    pixels[:wrong] += np.random.default_rng(1).uniform(60.0, 200.0, (wrong, 1, 2))
    return Markers(np.asarray(ids)[:count], pixels[:count])


@pytest.mark.parametrize("turn", range(4))
@pytest.mark.parametrize("from_top", [False, True])
def test_a_grid_is_placed_however_its_tags_are_turned_and_counted(
    turn: int, from_top: bool
) -> None:
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
