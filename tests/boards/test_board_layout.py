"""Where a board's corners lie, where a print appears in an image, and whose corners are given."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bodyscan.boards.board_layout import (
    compute_corner_points,
    compute_marker_corners,
    count_corners_per_face,
)
from bodyscan.boards.board_map import fit_board_map
from bodyscan.boards.view import Appearance, BoardView, number_corners
from bodyscan.errors import CaptureError
from bodyscan.rig.board import Board

sizes = st.integers(3, 30)


@given(sizes, sizes, st.floats(1, 200), st.floats(0, 20))
def test_corner_ids_count_along_columns_and_back_follows_front(
    columns: int, rows: int, square: float, thickness: float
) -> None:
    board = Board(
        name="b", columns=columns, rows=rows, square_mm=square, faces=2, thickness_mm=thickness
    )
    points, count = compute_corner_points(board), count_corners_per_face(board)
    assert points.shape == (2 * count, 3)
    for column, row in ((0, 0), (columns - 2, 0), (0, rows - 2), (columns - 2, rows - 2)):
        corner = row * (columns - 1) + column
        front = [(column + 1) * square, (row + 1) * square, 0.0]
        back = [(columns - column - 1) * square, (row + 1) * square, thickness]
        np.testing.assert_allclose(points[corner], front, rtol=1e-12)
        np.testing.assert_allclose(points[count + corner], back, rtol=1e-12, atol=1e-9)


@pytest.mark.parametrize("legacy", [False, True])
@pytest.mark.parametrize("size", [(9, 7), (8, 10), (8, 11), (9, 8)])
def test_markers_stand_in_the_white_squares(size: tuple[int, int], legacy: bool) -> None:
    columns, rows = size
    board = Board(
        name="b", kind="charuco", columns=columns, rows=rows, square_mm=10, marker_mm=8,
        legacy_layout=legacy, faces=2, first_marker=5,
    )  # fmt: skip
    ids, corners = compute_marker_corners(board)
    back_ids, back_corners = compute_marker_corners(board, 1)
    np.testing.assert_array_equal(ids, 5 + np.arange(columns * rows // 2))
    np.testing.assert_array_equal(back_ids, ids[-1] + 1 + np.arange(len(ids)))
    np.testing.assert_array_equal(corners, back_corners)
    square = np.floor(corners.mean(axis=1) / 10).astype(int)
    # OpenCV's old layout begins with white when there is an even number of rows.
    white = 0 if legacy and rows % 2 == 0 else 1
    assert np.all(square.sum(axis=1) % 2 == white)
    np.testing.assert_allclose(corners[:, 2] - corners[:, 0], 8.0, atol=1e-5)


TRUE = np.array([[2.2, -0.3, 140.0], [0.25, 2.1, 130.0], [4e-4, -3e-4, 1.0]])


def printed(columns: int, rows: int) -> np.ndarray:
    x, y = np.meshgrid(30.0 * np.arange(1, columns + 1), 30.0 * np.arange(1, rows + 1))
    return np.stack([x.ravel(), y.ravel()], axis=-1)


def project(points: np.ndarray, distortion: float = 0.0) -> np.ndarray:
    there = np.column_stack([points, np.ones(len(points))]) @ TRUE.T
    pixels = there[:, :2] / there[:, 2:]
    error = (pixels - [400.0, 300.0]) / 300.0
    return np.asarray(pixels + distortion * error * np.sum(error**2, axis=1)[:, None])


def test_without_a_lens_it_is_the_homography_and_its_slopes() -> None:
    points = printed(9, 6)
    found = fit_board_map(points, project(points))
    points_ = np.array([[33.0, 71.0], [200.0, 155.0]])
    np.testing.assert_allclose(found.apply(points_), project(points_), atol=1e-6)
    for k, step in enumerate(np.eye(2)):
        slope = (project(points_ + 1e-3 * step) - project(points_ - 1e-3 * step)) / 2e-3
        np.testing.assert_allclose(found.jacobian(points_)[..., k], slope, rtol=1e-5)
    np.testing.assert_allclose(found.middle, [150.0, 105.0])
    assert found.size == 120.0


def test_a_gentle_lens_is_followed_where_points_are_many() -> None:
    points = printed(9, 6)
    found = fit_board_map(points, project(points, 3.0))
    error = found.apply(points) - project(points, 3.0)
    # Three pixels at 300 from the middle: a homography alone is error by half of one.
    assert np.sqrt(np.mean(error**2)) < 0.05
    few = printed(3, 3)
    error = fit_board_map(few, project(few, 30.0)).apply(few) - project(few, 30.0)
    assert np.sqrt(np.mean(error**2)) > 0.05, "nine points leave a lens open"


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
