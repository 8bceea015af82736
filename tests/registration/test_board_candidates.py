"""Where a board might be held for further shots, and what cameras would see of it there."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from bodyscan.boards.board_layout import corner_points
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses.radial import Radial
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.registration.more_shots import (
    _tilted_poses,
    _views,
    candidate_azimuths,
    propose_board_poses,
)
from bodyscan.registration.rig_frame import nominal_pose
from bodyscan.rig.board import Board
from bodyscan.rig.pair import NominalPose
from bodyscan.rig.rig import Volume

CAMERA = Camera(900.0, 900.0, 0.0, 319.5, 239.5, Radial(), 640, 480)
BOARD = Board(name="b", kind="checkerboard", columns=9, rows=7, square_mm=40)
FACE = np.array([0.0, 0.0, 1000.0])


def stood(azimuth_deg: float, height_mm: float = 1000.0, away_mm: float = 1500.0) -> RigidTransform:
    """A camera that looks at the rig's axis."""
    at = np.radians(azimuth_deg)
    place = (away_mm * np.cos(at), away_mm * np.sin(at), height_mm)
    return nominal_pose(NominalPose(position_mm=place, look_at_mm=(0.0, 0.0, height_mm)))


def seen(pose: RigidTransform, board: Board = BOARD, **placed: RigidTransform) -> dict[str, Any]:
    return {view.pair: view for view in _views(board, pose, dict.fromkeys(placed, CAMERA), placed)}


def facing(azimuth_deg: float, board: Board = BOARD, centre: Any = FACE) -> list[RigidTransform]:
    at = np.radians(azimuth_deg)
    return list(_tilted_poses(board, np.array(centre), np.array([np.cos(at), np.sin(at), 0.0])))


def test_boards_face_halfway_between_any_two_cameras_in_steps_of_15_degrees() -> None:
    found = np.degrees(candidate_azimuths([stood(0.0), stood(60.0), stood(130.0)], two_faced=False))
    np.testing.assert_allclose(found, [30.0, 60.0, 90.0])  # 65 and 95 lie nearer to these
    # However far away either stands.
    apart = [stood(0.0), stood(60.0, away_mm=500.0)]
    np.testing.assert_allclose(np.degrees(candidate_azimuths(apart, two_faced=False)), [30.0])
    # Opposite each other they have no way between; of two faces either will do.
    np.testing.assert_allclose(candidate_azimuths([stood(0.0), stood(180.0)], two_faced=False), [])
    behind = [stood(200.0), stood(260.0)]
    np.testing.assert_allclose(
        np.degrees(candidate_azimuths(behind, two_faced=False)), [225.0 + 0.0]
    )
    np.testing.assert_allclose(np.degrees(candidate_azimuths(behind, two_faced=True)), [45.0])


def test_boards_are_held_upright_about_a_place_a_little_tilted() -> None:
    poses = facing(40.0)
    assert len(poses) == 3
    ahead = np.array([np.cos(np.radians(40.0)), np.sin(np.radians(40.0)), 0.0])
    corners = corner_points(BOARD)
    for pose in poses:
        np.testing.assert_allclose(pose.apply(corners).mean(axis=0), FACE, atol=1e-9)
        lean = np.degrees(np.arccos(-pose.rotation[:, 2] @ ahead))
        assert lean == pytest.approx(20.0, abs=0.1)
        assert pose.rotation[:, 1] @ [0.0, 0.0, -1.0] > 0.9, "rows run down"
    assert len({tuple(np.round(pose.rotation.ravel(), 6)) for pose in poses}) == 3


@pytest.mark.parametrize(("turn_deg", "looks"), [(65.0, True), (68.0, False)])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_camera_sees_a_board_that_faces_it_by_66_degrees(
    turn_deg: float, looks: bool, side: float
) -> None:
    """A cosine of 0.4."""
    flat = np.column_stack([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])
    turn = RigidTransform.from_rotation_vector([0.0, 0.0, side * np.radians(turn_deg)], np.zeros(3))
    rotation = turn.rotation @ flat
    middle = 20.0 * np.array([BOARD.columns, BOARD.rows, 0.0])
    pose = RigidTransform(rotation, FACE - rotation @ middle)
    assert ("a" in seen(pose, a=stood(0.0))) == looks
    # From behind there is nothing to see, but of two faces.
    assert not seen(pose, a=stood(180.0))
    two = BOARD.model_copy(update={"faces": 2, "thickness_mm": 4.0})
    back = seen(pose, two, a=stood(180.0))
    assert bool(back) == looks
    if looks:
        np.testing.assert_array_equal(back["a"].points, corner_points(two)[-48:])


def test_what_a_camera_would_see_is_where_it_projects_it() -> None:
    pose = facing(10.0)[0]
    placed = stood(0.0)
    view = seen(pose, a=placed)["a"]
    assert (view.board, len(view.points)) == ("b", 48)
    there = placed.inverse().apply(pose.apply(view.points))
    np.testing.assert_allclose(CAMERA.project(there), view.pixels, atol=1e-9)
    np.testing.assert_allclose(
        view.camera_from_board.matrix, (placed.inverse() @ pose).matrix, atol=1e-12
    )


@pytest.mark.parametrize(
    ("rise_mm", "corners"), [(300.0, 48), (530.0, 24), (532.0, 16), (580.0, 0)]
)
def test_a_board_is_seen_in_part_if_twelve_corners_are(rise_mm: float, corners: int) -> None:
    """Rows of eight leave the picture one by one: at 1500 mm it ends, but for 5 px, 391 mm over its
    middle; the board hangs 120 mm lower."""
    upright = RigidTransform(
        np.column_stack([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]]), np.zeros(3)
    )
    middle = 20.0 * np.array([BOARD.columns, BOARD.rows, 0.0])
    centre = FACE + [0.0, 0.0, rise_mm - 120.0]
    pose = RigidTransform(upright.rotation, centre - upright.rotation @ middle)
    found = seen(pose, a=stood(0.0))
    assert len(found["a"].points if found else []) == corners


def test_places_are_those_that_two_pairs_would_see_within_the_volume() -> None:
    placed = {"a": stood(-25.0), "b": stood(25.0), "c": stood(180.0)}
    places = propose_board_poses(BOARD, Volume(), dict.fromkeys(placed, CAMERA), placed)
    assert places
    heights = {"knee": 500.0, "waist": 1000.0, "chest": 1350.0}
    assert {place.height for place in places} <= set(heights)
    for place in places:
        assert set(place.visible_to) == {"a", "b"}
        assert place.facing_deg == pytest.approx(0.0)
        assert place.centre_mm[2] == heights[place.height]
    radius = Volume().radius_mm
    along = sorted(place.centre_mm[0] for place in places if place.height == "waist")
    np.testing.assert_allclose(along, [-0.35 * radius, 0.0, 0.35 * radius])
    alone = {"a": placed["a"], "c": placed["c"]}
    assert not propose_board_poses(BOARD, Volume(), dict.fromkeys(alone, CAMERA), alone)


@pytest.mark.parametrize(("columns", "rows", "whole"), [(5, 4, True), (12, 3, True), (3, 6, False)])
def test_twelve_corners_are_enough(columns: int, rows: int, whole: bool) -> None:
    """Whole boards of 12, 22 and 10."""
    small = Board(name="b", kind="checkerboard", columns=columns, rows=rows, square_mm=20)
    assert bool(seen(facing(0.0, small)[0], small, a=stood(0.0))) is whole
