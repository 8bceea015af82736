"""Where a board's corners and markers lie, and where a print appears in an image."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bodyscan.boards.board_layout import corner_points, corners_per_face, marker_corners
from bodyscan.boards.board_map import fit_board_map
from bodyscan.rig.board import Board

sizes = st.integers(3, 30)


@given(sizes, sizes, st.floats(1, 200), st.floats(0, 20))
def test_corner_ids_count_along_columns_and_back_follows_front(
    columns: int, rows: int, square: float, thickness: float
) -> None:
    board = Board(
        name="b", columns=columns, rows=rows, square_mm=square, faces=2, thickness_mm=thickness
    )
    points, count = corner_points(board), corners_per_face(board)
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
    ids, corners = marker_corners(board)
    back_ids, back_corners = marker_corners(board, 1)
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
