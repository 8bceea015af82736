"""Views of one board at one moment that cannot all be true, on exact pixels."""

from __future__ import annotations

import numpy as np
import pytest

from bodyscan.calibration.board_views import LocatedView
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses.radial import Radial
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.registration.joint_solve import JointSolution
from bodyscan.registration.view_consistency import (
    InconsistentViews,
    find_inconsistent_views,
    single_view_errors,
)

CAMERA = Camera(900.0, 900.0, 0.0, 320.0, 240.0, Radial(), 640, 480)
PLACED = {
    "a": RigidTransform.identity(),
    "b": RigidTransform.from_rotation_vector([0.0, 0.5, 0.0], [-520.0, 0.0, 90.0]),
    "c": RigidTransform.from_rotation_vector([0.0, -0.5, 0.1], [500.0, 30.0, 90.0]),
    "d": RigidTransform.from_rotation_vector([0.4, 0.0, 0.0], [20.0, 420.0, 60.0]),
}
CAMERAS = dict.fromkeys(PLACED, CAMERA)
POINTS = np.array([[40.0 * (k % 6), 40.0 * (k // 6), 0.0] for k in range(30)])
BOARD = RigidTransform.from_rotation_vector([0.2, 0.1, 0.1], [-80.0, -60.0, 1000.0])
LIMIT_PX = 0.2


def view(
    pair: str, *, shot: str = "s1", size: float = 1.0, aside_mm: float = 0.0, noise_px: float = 0.0
) -> LocatedView:
    """size: of the squares against those of the rig file; such a board seems nearer."""
    moved = RigidTransform(np.eye(3), np.array([0.6, 0.8, 0.0]) * aside_mm) @ BOARD
    there = PLACED[pair].inverse() @ moved
    pixels = CAMERA.project(there.apply(size * POINTS))
    pixels = pixels + noise_px * np.random.default_rng(1).standard_normal(pixels.shape)
    located = RigidTransform(there.rotation, there.translation / size)
    return LocatedView(pair, shot, "board", POINTS, pixels, located)


def judged(*views: LocatedView, limit_px: float = LIMIT_PX) -> InconsistentViews:
    boards = {one.target: BOARD for one in views}
    return find_inconsistent_views(views, JointSolution(PLACED, boards, CAMERAS), limit_px)


def test_views_that_agree_are_all_right() -> None:
    found = judged(*(view(pair, noise_px=0.05) for pair in "abcd"))
    assert (found.wrong, found.notes, found.sizes) == ((), (), ())
    errors = single_view_errors([view(pair) for pair in "abcd"], CAMERAS)
    np.testing.assert_allclose(errors, 0.0, atol=1e-9)


def test_a_board_that_stood_elsewhere_for_one_camera_costs_that_view() -> None:
    found = judged(*(view(pair, aside_mm=5.0 if pair == "c" else 0.0) for pair in "abcd"))
    assert [one.pair for one in found.wrong] == ["c"]
    assert "shot s1: the pose of board board differs for c" in found.notes[0]
    # A tenth of a millimetre is a tenth of a pixel.
    assert not judged(*(view(pair, aside_mm=0.1 if pair == "c" else 0.0) for pair in "abcd")).wrong


def test_corners_that_fit_no_pose_are_not_used_and_the_others_are() -> None:
    found = judged(view("a"), view("b"), view("c", noise_px=0.6), view("d"))
    assert [one.pair for one in found.wrong] == ["c"]
    assert "c: board board in shot s1 fits no pose" in found.notes[0]


@pytest.mark.parametrize("size", [1.02, 0.98])
def test_a_board_with_other_squares_is_another_board(size: float) -> None:
    views = [view(pair, size=size) for pair in "abcd"]
    found = judged(*views)
    assert len(found.wrong) == 4
    assert f"are {size:.3f} times as large as described" in found.notes[0]
    ((name, seen),) = found.sizes
    assert name == "board"
    assert seen == pytest.approx(size, abs=1e-3)


def test_squares_off_by_less_than_half_a_percent_are_of_no_other_board() -> None:
    """0.4 % put the board 4 mm too near, which no two of the cameras agree on to 0.1 px."""
    found = judged(*(view(pair, size=1.004) for pair in "abcd"), limit_px=0.1)
    assert found.sizes == ()
    assert "another board" not in " ".join(found.notes)
    assert "differs for" in found.notes[0]


def test_the_same_other_size_in_three_shots_is_the_boards() -> None:
    shots = [view(pair, shot=shot, size=1.02) for shot in ("s1", "s2", "s3") for pair in "abcd"]
    found = judged(*shots)
    assert found.notes[0].startswith("board board has squares 1.020 times as large")
    assert len(found.wrong) == 12
