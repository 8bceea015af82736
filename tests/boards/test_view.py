"""Corners that another program found, and prints that show otherwise than described."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from bodyscan.boards.view import Appearance, BoardView, number_corners
from bodyscan.errors import CaptureError
from bodyscan.rig.board import Board

PLAIN = Board(name="b", columns=5, rows=4, square_mm=40)
GRID = Board(name="b", kind="aprilgrid", columns=3, rows=3, square_mm=40, marker_mm=30)
MARKED = Board(name="b", kind="charuco", columns=5, rows=4, square_mm=40, marker_mm=30)


def grid(columns: int, rows: int) -> np.ndarray:
    """(N, 2) row by row, turned a little."""
    x, y = np.meshgrid(np.arange(columns), np.arange(rows))
    return np.stack([50.0 + 20.0 * x - 3.0 * y, 40.0 + 5.0 * x + 20.0 * y], axis=-1).reshape(-1, 2)


def numbered(pixels: np.ndarray, board: Board = PLAIN, size: tuple[int, int] = (320, 240)) -> Any:
    return number_corners(pixels, board, size, pair="p", shot="s", where="corners.csv")


def test_corners_are_numbered_row_by_row_and_those_not_found_left_out() -> None:
    pixels = grid(4, 3)
    pixels[5, 0] = np.nan
    view: BoardView = numbered(pixels)
    assert view.key == ("p", "s", "b")
    assert view.corner_ids.tolist() == [0, 1, 2, 3, 4, 6, 7, 8, 9, 10, 11]
    assert np.array_equal(view.pixels, np.delete(pixels, 5, axis=0))
    assert view.turnable
    assert not numbered(grid(4, 3), MARKED).turnable


@pytest.mark.parametrize("turns", [0, 1, 2, 3])
def test_rows_that_run_from_the_other_side_are_turned_round(turns: int) -> None:
    quarter = np.linalg.matrix_power(np.array([[0.0, -1.0], [1.0, 0.0]]), turns)
    middle = np.array([110.0, 110.0])
    turned = (grid(4, 3) - middle) @ quarter.T + middle
    assert np.array_equal(numbered(turned).pixels, turned)
    mirrored = turned.reshape(3, 4, 2)[:, ::-1].reshape(-1, 2)
    assert np.array_equal(numbered(mirrored).pixels, turned)
    mirrored[[0, 7]] = np.nan
    left = np.flatnonzero(np.isfinite(mirrored.reshape(3, 4, 2)[:, ::-1]).all(axis=2))
    found = numbered(mirrored)
    assert found.corner_ids.tolist() == left.tolist()
    assert np.array_equal(found.pixels, turned[left])


def test_a_grid_of_tags_has_two_corners_a_tag() -> None:
    pixels = grid(6, 6)
    mirrored = pixels.reshape(6, 6, 2)[:, ::-1].reshape(-1, 2)
    assert np.array_equal(numbered(mirrored, GRID).pixels, pixels)
    with pytest.raises(CaptureError) as caught:
        numbered(pixels[:-1], GRID)
    assert "has 35 corners, but board b has 36" in str(caught.value)
    assert "list all 6 x 6" in str(caught.value)


def test_too_few_too_many_and_none() -> None:
    with pytest.raises(CaptureError) as caught:
        numbered(grid(4, 4))
    assert "has 16 corners, but board b has 12" in str(caught.value)
    assert "list all 4 x 3" in str(caught.value)
    assert numbered(np.full((12, 2), np.nan)) is None


@pytest.mark.parametrize("pixel", [(-0.6, 40.0), (50.0, -0.6), (319.6, 40.0), (50.0, 239.6)])
def test_corners_outside_the_image_are_refused(pixel: tuple[float, float]) -> None:
    pixels = grid(4, 3)
    pixels[4] = pixel
    with pytest.raises(CaptureError, match="outside of 320 x 240 px"):
        numbered(pixels)


@pytest.mark.parametrize("inverted", [False, True])
@pytest.mark.parametrize("mirrored", [False, True])
def test_a_pixel_of_the_print_is_found_again_in_the_image(inverted: bool, mirrored: bool) -> None:
    image = np.random.default_rng(0).integers(0, 256, (7, 11), dtype=np.uint8)
    appearance = Appearance(inverted=inverted, mirrored=mirrored)
    upright = appearance.undo(image)
    v, u = np.indices(image.shape)
    there = appearance.original_pixels(np.stack([u, v], axis=-1).astype(float), 11).astype(int)
    again = image[there[..., 1], there[..., 0]]
    assert np.array_equal(upright, 255 - again if inverted else again)
    assert upright.flags.c_contiguous
