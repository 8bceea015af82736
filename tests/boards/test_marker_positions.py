"""Locating a board by the markers that agree."""

from __future__ import annotations

import numpy as np
import pytest

from bodyscan.arrays import Array, Mask
from bodyscan.boards.aprilgrid import locate_grid
from bodyscan.boards.board_layout import marker_corners
from bodyscan.boards.charuco import FacePosition, Markers, fit_markers, locate_face
from bodyscan.rig.board import Board

BOARD = Board(name="b", kind="charuco", columns=9, rows=8, square_mm=50, marker_mm=40)


def printed() -> Array:
    return np.asarray(marker_corners(BOARD)[1])[..., :2]


def image_of(points: Array, scale: float) -> Array:
    """A board that leans back a little."""
    x, y = points[..., 0], points[..., 1]
    away = 1.0 + 2e-4 * x + 1e-4 * y
    return np.asarray(np.stack([300.0 + scale * x, 200.0 + scale * y], axis=-1) / away[..., None])


def agreeing(off_px: float, *, scale: float, marker: int = 17) -> Mask:
    """With one marker of the middle moved aside."""
    pixels = image_of(printed(), scale)
    pixels[marker, :, 0] += off_px
    fit = fit_markers(printed(), pixels, BOARD)
    assert fit is not None
    return fit[1]


@pytest.mark.parametrize(("scale", "most_px"), [(1.2, 8.5), (0.2, 2.0)])
def test_a_marker_off_by_a_seventh_of_a_square_or_two_pixels_does_not_agree(
    scale: float, most_px: float
) -> None:
    """Of squares that appear 57 px wide 15 % are 8.5; the fit goes along with one of 36 by less than
    a tenth."""
    assert agreeing(0.88 * most_px, scale=scale).all()
    one = agreeing(1.12 * most_px, scale=scale)
    assert not one[17]
    assert one.sum() == 35


def test_two_markers_have_to_agree() -> None:
    points = printed()
    pixels = image_of(points, 1.0)
    assert fit_markers(points[:2], pixels[:2], BOARD) is not None
    apart = pixels[:2].copy()
    apart[1] = apart[1, ::-1]  # mirrored: no board shows both so
    assert fit_markers(points[:2], apart, BOARD) is None


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


def test_six_of_ten_markers_have_to_agree() -> None:
    ids, points = marker_corners(BOARD)
    position = locate_face(BOARD, Markers(np.asarray(ids), image_of(points[..., :2], 1.0)))
    assert position is not None

    def of_ten(agreeing: int) -> FacePosition:
        return FacePosition(position.board, 0, position.board_map, position.printed[:agreeing], 10)

    assert [of_ten(count).valid for count in (5, 6, 7)] == [False, False, True]


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


@pytest.mark.parametrize(("first_px", "whole"), [(0.3, True), (-0.3, False)])
@pytest.mark.parametrize("axis", [0, 1])
def test_a_marker_at_the_pictures_first_pixels_lies_wholly_within_it(
    first_px: float, whole: bool, axis: int
) -> None:
    """One that begins at pixel 0.3 could have been seen; the map is good to 0.01."""
    ids, points = marker_corners(BOARD)
    pixels = 20.0 + points[..., :2]
    pixels[..., axis] += first_px - pixels[..., axis].min()
    others = pixels[..., axis].min(axis=1) > 1.0  # all but the first column, or row
    position = locate_face(BOARD, Markers(np.asarray(ids)[others], pixels[others]))
    assert position is not None
    assert 0 < position.agreeing == others.sum() < len(pixels)
    assert position.complete((500, 500)) != whole
