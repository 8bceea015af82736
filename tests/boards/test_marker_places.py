"""Which markers agree on where a board is, and which corners lie beside them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from bodyscan.arrays import Array, Mask
from bodyscan.boards import charuco
from bodyscan.boards.appearance import AS_PRINTED, OTHERWISE, Appearance
from bodyscan.boards.aprilgrid import _clear_of_edges, place_tags
from bodyscan.boards.board_layout import marker_corners
from bodyscan.boards.board_map import fit_board_map
from bodyscan.boards.charuco import (
    Markers,
    PlacedMarkers,
    _corners_beside,
    fit_markers,
    place_markers,
)
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


def test_where_a_board_lies_is_where_its_markers_say() -> None:
    ids, points = marker_corners(BOARD)
    pixels = image_of(points[..., :2], 1.0)
    some = np.arange(3, 36, 4)
    placed = place_markers(BOARD, Markers(np.asarray(ids)[some], pixels[some]))
    assert placed is not None
    assert (placed.agreeing, placed.seen, placed.face, placed.believed) == (9, 9, 0, True)
    corner = np.array([[200.0, 150.0]])
    np.testing.assert_allclose(placed.board_map.apply(corner), image_of(corner, 1.0), atol=0.01)
    one = Markers(np.asarray(ids)[:1], pixels[:1])
    assert place_markers(BOARD, one) is None


def test_six_of_ten_markers_have_to_agree() -> None:
    ids, points = marker_corners(BOARD)
    placed = place_markers(BOARD, Markers(np.asarray(ids), image_of(points[..., :2], 1.0)))
    assert placed is not None

    def of_ten(agreeing: int) -> PlacedMarkers:
        return PlacedMarkers(placed.board, 0, placed.board_map, placed.printed[:agreeing], 10)

    assert [of_ten(count).believed for count in (5, 6, 7)] == [False, False, True]


def test_corners_beside_a_square_are_those_of_its_four_that_the_board_has() -> None:
    """Of 8 x 7 inner corners; the square in column 2, row 1 touches corners 1 and 2 of rows 0, 1."""
    assert _corners_beside(BOARD, np.array([[125.0, 75.0]])).tolist() == [1, 2, 9, 10]
    assert _corners_beside(BOARD, np.array([[25.0, 25.0]])).tolist() == [0]
    last = np.array([[8.5 * 50.0, 7.5 * 50.0]])
    assert _corners_beside(BOARD, last).tolist() == [55]
    right = np.array([[8.5 * 50.0, 2.5 * 50.0], [7.5 * 50.0, 1.5 * 50.0]])
    assert _corners_beside(BOARD, right).tolist() == [6, 7, 14, 15, 23]


TAGS = Board(name="t", kind="aprilgrid", columns=6, rows=5, square_mm=120, marker_mm=90)


def tags(turn: int = 0, *, from_top: bool = False, wrong: int = 0, seen: int = 30) -> Markers:
    """As a grid's first tags appear, each turned in its place; the wrong ones lie elsewhere."""
    ids, points = marker_corners(TAGS)
    order = points.reshape(5, 6, 4, 2)
    order = order[::-1] if from_top else order
    pixels = image_of(np.roll(order.reshape(-1, 4, 2), turn, axis=1), 0.5)
    pixels[:wrong] += np.random.default_rng(1).uniform(60.0, 200.0, (wrong, 1, 2))
    return Markers(np.asarray(ids)[:seen], pixels[:seen])


@pytest.mark.parametrize("turn", range(4))
@pytest.mark.parametrize("from_top", [False, True])
def test_a_grid_is_placed_however_its_tags_are_turned_and_counted(
    turn: int, from_top: bool
) -> None:
    placed = place_tags(TAGS, tags(turn, from_top=from_top))
    assert placed is not None
    assert placed.agreeing == 30
    corner = np.array([[200.0, 150.0]])
    np.testing.assert_allclose(placed.board_map.apply(corner), image_of(corner, 0.5), atol=0.01)


def test_three_tags_and_six_of_ten_have_to_agree() -> None:
    assert place_tags(TAGS, tags(seen=2)) is None
    placed = place_tags(TAGS, tags(seen=3))
    assert placed is not None
    assert placed.agreeing == 3
    placed = place_tags(TAGS, tags(wrong=11))
    assert placed is not None
    assert placed.agreeing == 19
    assert place_tags(TAGS, tags(wrong=13)) is None


def test_around_a_corner_only_rim_gap_and_small_squares_are_clear() -> None:
    """A tag of six bits and a rim of two on either side: the rim is 18 mm, the gap 30; of a rim one
    wide 11.25. A window fills 85 % of it."""
    assert _clear_of_edges(TAGS, 2) == pytest.approx(0.85 * 18.0)
    assert _clear_of_edges(TAGS, 1) == pytest.approx(0.85 * 11.25)
    tight = TAGS.model_copy(update={"marker_mm": 110.0})
    assert _clear_of_edges(tight, 2) == pytest.approx(0.85 * 10.0)


def test_a_print_seen_in_a_mirror_or_in_white_is_put_right() -> None:
    image = np.arange(12, dtype=np.uint8).reshape(3, 4)
    np.testing.assert_array_equal(AS_PRINTED.as_printed(image), image)
    mirrored = Appearance(mirrored=True)
    np.testing.assert_array_equal(mirrored.as_printed(image), image[:, ::-1])
    np.testing.assert_array_equal(Appearance(inverted=True).as_printed(image), 255 - image)
    pixels = np.array([[0.0, 2.0], [2.5, 0.0]])
    np.testing.assert_array_equal(mirrored.in_image(pixels, 4), [[3.0, 2.0], [0.5, 0.0]])
    np.testing.assert_array_equal(AS_PRINTED.in_image(pixels, 4), pixels)
    assert Appearance(False, False, False, False) == AS_PRINTED
    assert len({AS_PRINTED, *OTHERWISE}) == 4  # all that a picture may look like


@pytest.mark.parametrize(
    ("found", "looked"), [(11, 1), (12, 2), (55, 2), (56, 1)], ids=["few", "enough", "most", "all"]
)
def test_corners_not_found_are_looked_for_once_more_where_a_dozen_others_say(
    found: int, looked: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Markers 3 px off say where corners are; then corners say it better."""
    x, y = np.meshgrid(50.0 * np.arange(1, 9), 50.0 * np.arange(1, 8))
    true = image_of(np.stack([x.ravel(), y.ravel()], axis=-1), 1.0)
    asked: list[Array] = []

    def refine(image: Any, start: Array, *_: Any, **__: Any) -> tuple[Array, Mask]:
        asked.append(start)
        good = np.arange(56) % 56 < found if len(asked) == 1 else np.arange(56) >= 40
        return np.where(good[:, None], true + 0.1 * (len(asked) - 1), start), good

    monkeypatch.setattr(charuco, "refine_corners", refine)
    outer = marker_corners(BOARD)[1][..., :2]
    off = fit_board_map(outer.reshape(-1, 2), image_of(outer.reshape(-1, 2), 1.0) + 3.0)
    nothing: Any = None
    pixels, good = charuco._refine(nothing, BOARD, off, np.arange(56), outer)
    assert len(asked) == looked
    assert np.abs(asked[0] - true).min() > 2.9
    again = (np.arange(56) >= 40) if looked == 2 else np.zeros(56, bool)
    assert good.tolist() == ((np.arange(56) < found) | again).tolist()
    # What was found at first stays.
    np.testing.assert_allclose(pixels[:found], true[:found])
    if looked == 2:
        # A dozen corners of two rows tell a homography: it is exact.
        assert np.abs(asked[1] - true).max() < 0.01
        np.testing.assert_allclose(pixels[max(found, 40) :], true[max(found, 40) :] + 0.1)


@pytest.mark.parametrize(("first_px", "whole"), [(0.3, True), (-0.3, False)])
@pytest.mark.parametrize("axis", [0, 1])
def test_a_marker_at_the_pictures_first_pixels_lies_wholly_within_it(
    first_px: float, whole: bool, axis: int
) -> None:
    """One that begins at pixel 0.3 could have been seen; the map is good to 0.01."""
    ids, points = marker_corners(BOARD)
    pixels = 20.0 + points[..., :2]
    pixels[..., axis] += first_px - pixels[..., axis].min()
    beside = pixels[..., axis].min(axis=1) > 1.0  # all but the first column, or row
    placed = place_markers(BOARD, Markers(np.asarray(ids)[beside], pixels[beside]))
    assert placed is not None
    assert 0 < placed.agreeing == beside.sum() < len(pixels)
    assert placed.all_seen((500, 500)) != whole
