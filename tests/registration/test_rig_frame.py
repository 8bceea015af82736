"""The rig frame lies where the rig file says, by a board on the floor or by a pair."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from bodyscan.calibration.board_views import find_board_symmetries
from bodyscan.errors import BadInput
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.geometry.uncertainty import PoseCovariance
from bodyscan.registration.rig_calibration import FLOOR_AXES, RigCalibration
from bodyscan.registration.rig_frame import (
    compute_nominal_pose,
    find_frame_board_rotation,
    find_frame_target,
    find_rig_from_root,
    refuse_without_frame_shot,
    rig_from_world,
)
from bodyscan.registration.view_graph import RelativePose
from bodyscan.rig.board import Board
from bodyscan.rig.pair import NominalPose
from bodyscan.rig.rig import Rig

PLAIN = {"name": "b", "columns": 8, "rows": 6, "square_mm": 40}
SOMEWHERE = RigidTransform.from_rotation_vector([0.3, -1.1, 0.7], [120.0, -40.0, 900.0])


def rig(frame: dict[str, Any], board: dict[str, Any] = PLAIN, **nominal: Any) -> Rig:
    pairs = [
        {"name": name, "camera": {"width": 640, "height": 480}}
        | ({"nominal": nominal[name]} if name in nominal else {})
        for name in ("p", "q")
    ]
    return Rig.model_validate({"name": "r", "boards": (board,), "pairs": pairs, "rig_frame": frame})


def test_a_rig_whose_frame_shot_was_not_captured_is_refused_before_any_work() -> None:
    on_floor = rig({"shot": "floor", "board": "b"})
    refuse_without_frame_shot(on_floor, ["b01", "floor"])
    with pytest.raises(BadInput, match=r"there is no shot 'floor' \(did you mean 'flor'\?\)"):
        refuse_without_frame_shot(on_floor, ["b01", "flor"])
    refuse_without_frame_shot(rig({"pair": "p"}), [])


def test_placed_cameras_stay_unless_the_rig_file_places_one_that_holds_the_frame() -> None:
    stands = {"position_mm": (1500.0, 0.0, 900.0), "look_at_mm": (0.0, 0.0, 900.0)}
    world = {"p": SOMEWHERE, "q": SOMEWHERE.inverse()}
    assert rig_from_world(rig({"shot": "floor", "board": "b"}, p=stands), world) is None
    assert rig_from_world(rig({}), world) is None
    moved = rig_from_world(rig({}, p=stands), world)
    assert moved is not None
    np.testing.assert_allclose((moved @ SOMEWHERE).translation, stands["position_mm"])
    named = rig_from_world(rig({"pair": "q"}), world)  # which has no pose of its own: the origin
    assert named is not None
    np.testing.assert_allclose(named.matrix, SOMEWHERE.matrix, atol=1e-9)


def test_the_axes_are_told_to_be_the_floors_where_board_or_pair_says_where_it_is() -> None:
    stands = {"position_mm": (1500.0, 0.0, 900.0), "look_at_mm": (0.0, 0.0, 900.0)}

    def told(given: Rig, placed: RigidTransform) -> str:
        nothing = PoseCovariance((), np.zeros((0, 0)))
        return RigCalibration(given, {}, {"p": placed}, nothing, {}, {}, ()).axes

    assert told(rig({"shot": "floor", "board": "b"}), SOMEWHERE) == FLOOR_AXES
    assert told(rig({"pair": "p"}, p=stands), SOMEWHERE) == FLOOR_AXES
    assert told(rig({"pair": "p"}), SOMEWHERE).startswith("that of camera p")
    assert told(rig({}), SOMEWHERE).startswith("that of the imported files")
    assert told(rig({}), RigidTransform.identity()).startswith("that of camera p")


@pytest.mark.parametrize(
    ("position", "look_at"),
    [
        ((1500.0, 0.0, 900.0), (0.0, 0.0, 900.0)),
        ((800.0, -900.0, 1700.0), (10.0, 20.0, 1000.0)),
        ((0.0, 0.0, 2500.0), (0.0, 0.0, 0.0)),
        ((5.0, 0.0, 100.0), (5.0, 0.0, 300.0)),
    ],
)
def test_a_nominal_pose_looks_where_it_says_and_stands_upright(
    position: tuple[float, float, float], look_at: tuple[float, float, float]
) -> None:
    pose = compute_nominal_pose(NominalPose(position_mm=position, look_at_mm=look_at))
    away = np.array(look_at) - position
    seen = pose.inverse().apply(np.array([look_at]))[0]
    np.testing.assert_allclose(seen, [0.0, 0.0, float(np.linalg.norm(away))], atol=1e-9)
    np.testing.assert_allclose(pose.translation, position)
    np.testing.assert_allclose(pose.rotation @ pose.rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(pose.rotation) == pytest.approx(1.0)
    across, down = pose.rotation[:, 0], pose.rotation[:, 1]
    if abs(away[2]) < np.linalg.norm(away):
        assert across[2] == pytest.approx(0.0), "the picture's rows are level"
        assert down[2] < 0.0
    else:  # straight up or down: its rows are along the rig's y
        assert abs(across[1]) == pytest.approx(1.0)


def test_a_board_on_the_floor_is_the_frame() -> None:
    described = rig(
        {"shot": "s1", "origin_mm": (100, 50, 3), "x_axis": (0, 2, 0), "y_axis": (3, 0, 0)}
    )
    assert find_frame_target(described) == ("s1", "b")
    to_rig = find_rig_from_root(described, {}, {("s1", "b"): SOMEWHERE})
    on_board = np.array([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0], [0.0, 10.0, 0.0], [0.0, 0.0, 10.0]])
    np.testing.assert_allclose(
        to_rig.apply(SOMEWHERE.apply(on_board)),
        [[100, 50, 3], [100, 60, 3], [110, 50, 3], [100, 50, -7]],
        atol=1e-9,
    )
    with pytest.raises(BadInput, match="board b in shot s1"):
        find_rig_from_root(described, {}, {("s2", "b"): SOMEWHERE})


def test_a_pair_is_the_frame_at_its_nominal_pose_or_as_it_is() -> None:
    stands = {"position_mm": (1500, 0, 900), "look_at_mm": (0, 0, 900)}
    described = rig({"pair": "q"}, q=stands)
    assert find_frame_target(described) is None
    to_rig = find_rig_from_root(described, {"q": SOMEWHERE}, {})
    nominal = compute_nominal_pose(NominalPose.model_validate(stands))
    np.testing.assert_allclose((to_rig @ SOMEWHERE).matrix, nominal.matrix, atol=1e-9)
    to_rig = find_rig_from_root(rig({"pair": "q"}), {"q": SOMEWHERE}, {})
    np.testing.assert_allclose((to_rig @ SOMEWHERE).matrix, np.eye(4), atol=1e-12)
    with pytest.raises(BadInput, match="pair q, which could not be calibrated"):
        find_rig_from_root(described, {"p": SOMEWHERE}, {})


TWO_FACES = {**PLAIN, "faces": 2, "thickness_mm": 5.0}
PLACES: dict[str, tuple[float, float, float]] = {"p": (1400, 200, 900), "q": (-900, 1000, 1500)}


@pytest.mark.parametrize("read", range(4))
@pytest.mark.parametrize("nominal", [True, False])
def test_of_all_readings_of_a_plain_board_the_one_that_puts_cameras_where_they_stand(
    read: int, nominal: bool
) -> None:
    """With nominal places all four are told; without, above the floor from below it: the faces."""
    stands = {
        name: {"position_mm": tuple(np.add(place, 100.0)), "look_at_mm": (0, 0, 800)}
        for name, place in PLACES.items()
    }
    described = rig({"shot": "s1"}, TWO_FACES, **(stands if nominal else {}))
    turn = find_board_symmetries(described.boards[0])[read]
    axes = np.diag([1.0, -1.0, -1.0])  # the default: columns along x, face up
    lies = RigidTransform(axes, np.zeros(3))
    cameras = {
        name: SOMEWHERE
        @ compute_nominal_pose(NominalPose(position_mm=place, look_at_mm=(0, 0, 800)))
        for name, place in PLACES.items()
    }
    # What was seen is the board as it lies, read in one of its ways.
    seen = {("s1", "b"): SOMEWHERE @ lies @ turn}
    found = find_frame_board_rotation(described, cameras, seen)
    right = {("s1", "b"): seen["s1", "b"] @ found.inverse()}
    to_rig = find_rig_from_root(described, cameras, right)
    for name, place in PLACES.items():
        found_at = (to_rig @ cameras[name]).translation
        if nominal:
            np.testing.assert_allclose(found_at, place, atol=1e-6)
        else:
            assert found_at[2] == pytest.approx(place[2], abs=5.1)


def test_a_plain_board_reads_alike_from_its_ends_and_faces_where_its_print_does() -> None:
    def readings(columns: int, faces: int) -> list[np.ndarray]:
        keys = {**PLAIN, "columns": columns, "faces": faces, "thickness_mm": 5.0 * (faces - 1)}
        places = np.array([[40.0, 80.0, 0.0], [0.0, 0.0, 0.0]])
        return [turn.apply(places) for turn in find_board_symmetries(Board.model_validate(keys))]

    itself = np.array([[40.0, 80.0, 0.0], [0.0, 0.0, 0.0]])
    turned = np.array([[280.0, 160.0, 0.0], [320.0, 240.0, 0.0]])
    np.testing.assert_allclose(readings(8, 1), [itself, turned])
    np.testing.assert_allclose(readings(7, 1), [itself])
    over = np.array([[240.0, 80.0, 5.0], [280.0, 0.0, 5.0]])
    np.testing.assert_allclose(readings(7, 2), [itself, over])
    assert len(readings(8, 2)) == 4


def test_a_board_that_tells_its_ends_is_left_as_it_was_read() -> None:
    marked = {**PLAIN, "kind": "charuco", "marker_mm": 30}
    found = find_frame_board_rotation(rig({"shot": "s1"}, marked), {}, {("s1", "b"): SOMEWHERE})
    assert np.array_equal(found.matrix, np.eye(4))
    found = find_frame_board_rotation(rig({"shot": "s1"}), {}, {})
    assert np.array_equal(found.matrix, np.eye(4))


def tie(agreeing: int, rivals: int, shared: int) -> RelativePose:
    targets = tuple((f"s{k}", "b") for k in range(shared))
    pose = RigidTransform.identity()
    return RelativePose(pose, targets, targets[:agreeing], rivals, 40, True)


@pytest.mark.parametrize(
    ("agreeing", "rivals", "shared", "decided"),
    [
        (1, 0, 1, True),
        (1, 1, 1, False),  # either end
        (2, 1, 3, True),
        (2, 0, 4, False),  # no more than half
        (2, 2, 3, False),
        (3, 1, 7, True),  # three, and no two agree on another
        (3, 2, 7, False),
        (4, 3, 7, True),
    ],
)
def test_most_boards_or_three_that_no_two_contradict_decide(
    agreeing: int, rivals: int, shared: int, decided: bool
) -> None:
    assert tie(agreeing, rivals, shared).votes == agreeing
    assert tie(agreeing, rivals, shared).decided is decided
