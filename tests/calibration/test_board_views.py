"""Views of boards: whether they have corners enough, and which poses look alike."""

from __future__ import annotations

import numpy as np
import pytest

from bodyscan.arrays import Indices
from bodyscan.boards.board_layout import compute_corner_points
from bodyscan.boards.view import BoardView
from bodyscan.calibration.board_views import (
    BoardFace,
    LocatedView,
    compute_max_displacement_mm,
    find_board_symmetries,
    has_enough_corners,
    make_planar_view,
    match_corners,
    measure_covered_share,
)
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.rig.board import Board

BOARD = Board(name="b", kind="checkerboard", columns=9, rows=8, square_mm=30)
WIDE = 8  # corners in a row


def view(ids: Indices) -> BoardView:
    found = BoardView("p", "s", "b", ids, np.ones((len(ids), 2)))
    assert not found.turnable, "unless a detector says so"
    return found


def block(columns: int, rows: int) -> Indices:
    return (WIDE * np.arange(rows)[:, None] + np.arange(columns)).ravel()


def test_a_view_needs_corners_enough_in_three_columns_and_three_rows() -> None:
    assert has_enough_corners(view(block(5, 5)), BOARD)
    assert has_enough_corners(view(block(3, 7)), BOARD)
    assert has_enough_corners(view(block(7, 3)), BOARD)
    assert not has_enough_corners(view(block(2, 7)), BOARD)
    assert not has_enough_corners(view(block(8, 2)), BOARD)
    assert has_enough_corners(view(block(3, 3)[:8]), BOARD)
    assert not has_enough_corners(view(block(3, 3)[:7]), BOARD)


def test_corners_of_the_back_count_by_their_place_on_it() -> None:
    two = BOARD.model_copy(update={"faces": 2})
    assert has_enough_corners(view(56 + block(5, 5)), two)
    assert not has_enough_corners(view(56 + block(8, 2)), two)
    np.testing.assert_array_equal(
        make_planar_view(view(56 + block(2, 2)), two).points,
        compute_corner_points(two)[[56, 57, 64, 65]],
    )


def test_poses_differ_by_how_far_they_carry_what_is_at_reach() -> None:
    one = RigidTransform.from_rotation_vector([0.2, 0.1, 0.0], [5.0, 6.0, 7.0])
    other = one @ RigidTransform.from_rotation_vector([0.0, 0.0, 0.01], [3.0, 0.0, 4.0])
    assert compute_max_displacement_mm(one, other, 500.0) == pytest.approx(10.0)
    assert compute_max_displacement_mm(one, one, 500.0) == pytest.approx(0.0, abs=1e-6)


def test_corners_fall_on_corners_of_a_board_that_looks_the_same() -> None:
    even = Board(name="e", kind="checkerboard", columns=8, rows=6, square_mm=30)
    both = even.model_copy(update={"faces": 2, "thickness_mm": 5.0})
    assert [len(find_board_symmetries(each)) for each in (BOARD, even, both)] == [1, 2, 4]
    points = compute_corner_points(both)

    def lattice(corners: np.ndarray) -> list[tuple[float, ...]]:
        return sorted(map(tuple, (np.round(corners, 6) + 0.0).tolist()))

    for symmetry in find_board_symmetries(both):
        assert lattice(symmetry.apply(points)) == lattice(points)
        np.testing.assert_allclose((symmetry @ symmetry).matrix, np.eye(4), atol=1e-9)


def test_an_alternative_taken_for_true_shows_the_same_points_to_the_camera() -> None:
    even = Board(name="e", kind="checkerboard", columns=8, rows=6, square_mm=30)
    symmetries = find_board_symmetries(even)
    points = compute_corner_points(even)
    at = RigidTransform.from_rotation_vector([0.2, -0.3, 0.1], [10.0, 20.0, 900.0])
    seen = LocatedView("p", "s", "e", points, points[:, :2], at, symmetries)
    assert seen.ambiguous
    resolved = seen.resolve(symmetries[1])
    assert not resolved.ambiguous
    np.testing.assert_allclose(
        resolved.camera_from_board.apply(resolved.points), at.apply(points), atol=1e-9
    )
    assert (resolved.key, resolved.target) == (("p", "s", "e"), ("s", "e"))


def test_corners_are_matched_by_position() -> None:
    points = compute_corner_points(BOARD)
    np.testing.assert_array_equal(match_corners(points[[7, 2]] + 1e-8, points), [7, 2])
    assert match_corners(points[:1] + 0.1, points).tolist() == [-1]


def test_a_face_fits_corners_that_lie_on_a_cubic() -> None:
    points = compute_corner_points(BOARD).copy()
    x, y = ((points[:, :2] - [135.0, 120.0]) / [105.0, 90.0]).T
    points[:, 2] = 7.0 + 0.3 * x**2 - 0.2 * x * y + 0.1 * y**3 + 0.05 * x * x * y
    face = BoardFace.fit(points)
    np.testing.assert_allclose(face.z_mm + face.height(points[:, :2]), points[:, 2], atol=1e-9)
    assert face.z_mm == pytest.approx(np.median(points[:, 2]))


def corners(left: float, top: float, width: float, height: float) -> np.ndarray:
    u, v = np.meshgrid(np.linspace(left, left + width, 8), np.linspace(top, top + height, 6))
    return np.column_stack([u.ravel(), v.ravel()])


def test_the_covered_share_of_the_picture_is_that_of_the_hulls() -> None:
    one, next_to = corners(0, 0, 320, 240), corners(320, 240, 319, 239)
    # The picture is divided into 64 cells each way.
    for views, share in (([one], 0.25), ([one, one], 0.25), ([one, next_to], 0.5)):
        assert measure_covered_share(views, 640, 480) == pytest.approx(share, abs=0.04)
    assert measure_covered_share([corners(0, 0, 639, 479)], 640, 480) == 1.0
