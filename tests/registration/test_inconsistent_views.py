"""Views of one board at one moment that cannot all be true, on exact pixels."""

from __future__ import annotations

import numpy as np

from bodyscan.calibration.board_views import LocatedView
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses.opencv import Radial
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.outcome import Outcome
from bodyscan.registration.joint_solve import JointSolution
from bodyscan.registration.view_consistency import (
    error_limit,
    find_inconsistent_views,
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


def judged(*views: LocatedView) -> Outcome[list[LocatedView]]:
    boards = {one.target: BOARD for one in views}
    return find_inconsistent_views(views, JointSolution(PLACED, boards, CAMERAS), 0.2)


def test_views_that_agree_are_all_right() -> None:
    found = judged(*(view(pair, noise_px=0.05) for pair in "abcd"))
    assert (found.value, found.notes) == ([], ())
    assert error_limit([view(pair) for pair in "abcd"], CAMERAS) == 0.2, "the least, without noise"


def test_a_board_that_stood_elsewhere_for_one_camera_costs_that_view() -> None:
    found = judged(*(view(pair, aside_mm=5.0 if pair == "c" else 0.0) for pair in "abcd"))
    assert [one.pair for one in found.value] == ["c"]
    assert "shot s1: the pose of board board differs for c" in found.notes[0]
    # A tenth of a millimetre is a tenth of a pixel.
    assert not judged(*(view(pair, aside_mm=0.1 if pair == "c" else 0.0) for pair in "abcd")).value


def test_corners_that_fit_no_pose_are_not_used_and_the_others_are() -> None:
    found = judged(view("a"), view("b"), view("c", noise_px=0.6), view("d"))
    assert [one.pair for one in found.value] == ["c"]
    assert "c: board board in shot s1 fits no pose" in found.notes[0]


def test_a_board_with_other_squares_is_not_used() -> None:
    found = judged(*(view(pair, size=1.02) for pair in "abcd"))
    assert len(found.value) == 4
    assert "or its square_mm is not that of the rig file" in found.notes[0]
