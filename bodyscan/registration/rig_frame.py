"""How the rig frame is fixed: by a board in one shot, or by one pair at its nominal pose."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence

import numpy as np

from bodyscan.calibration.board_views import LocatedView, find_board_symmetries
from bodyscan.errors import BadInput
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.registration.view_graph import Target
from bodyscan.rig.gauge import RigFrame
from bodyscan.rig.pair import NominalPose, Pair
from bodyscan.rig.rig import Rig


def compute_nominal_pose(nominal: NominalPose) -> RigidTransform:
    """`rig_from_camera` of a camera that looks from one point at another, upright."""
    position = np.array(nominal.position_mm)
    forward = np.array(nominal.look_at_mm) - position
    forward /= np.linalg.norm(forward)
    up = np.array([0.0, 0.0, 1.0]) if abs(forward[2]) < 0.999 else np.array([1.0, 0.0, 0.0])
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    return RigidTransform(np.column_stack([right, np.cross(forward, right), forward]), position)


def find_frame_target(rig: Rig) -> Target | None:
    """The (shot, board) that fixes the rig frame, or None if a pair does."""
    board, shot = rig.frame_board, rig.rig_frame.shot
    return (shot, board.name) if board and shot else None


def hold_frame(rig: Rig, views: Sequence[LocatedView], solved: Collection[str]) -> Rig:
    """The rig with its frame held by a pair that was solved, where the rig file names none.

    By default that is the first pair; without it the one that sees the most boards together with
    others takes its place, one with a nominal pose if the first has one.
    """
    first = rig.frame_pair
    if first is None or rig.rig_frame.pair or first.name in solved:
        return rig
    count = Counter(view.target for view in views)
    shared = Counter(view.pair for view in views if count[view.target] > 1)
    names = [pair.name for pair in rig.pairs if pair.name in solved]
    if first.nominal:
        names = [name for name in names if rig.pair(name).nominal] or names
    best = max(names, key=lambda name: shared[name])
    return rig.model_copy(update={"rig_frame": RigFrame(pair=best)})


def refuse_without_frame_shot(rig: Rig, shots: Collection[str]) -> None:
    """Raise BadInput if the shot that fixes the rig frame is none of `shots`."""
    if missing := rig.rig_frame.missing_shot(shots):
        raise BadInput(
            missing,
            where=f"rig {rig.name}",
            remedy="capture the board where it fixes the rig frame, or fix the frame by a pair "
            "(rig_frame: {pair: NAME})",
        )


def find_frame_board_rotation(
    rig: Rig,
    root_from_camera: Mapping[str, RigidTransform],
    root_from_board: Mapping[Target, RigidTransform],
) -> RigidTransform:
    """`board_from_observed` of the board that fixes the rig frame, if it is a plain one.

    Images cannot tell whether such a board is numbered from its other end or lies on its other
    face. Of all readings this takes the one that puts the cameras nearest to their nominal
    positions, or at least above the floor.
    """
    target = find_frame_target(rig)
    if (
        target is None
        or target not in root_from_board
        or rig.board(target[1]).kind != "checkerboard"
    ):
        return RigidTransform.identity()

    def total_displacement(turn: RigidTransform) -> float:
        rotated = {target: root_from_board[target] @ turn.inverse()}
        to_rig = find_rig_from_root(rig, root_from_camera, rotated)
        total = 0.0
        for name, root_from_camera_pose in root_from_camera.items():
            position, nominal = (to_rig @ root_from_camera_pose).translation, rig.pair(name).nominal
            meant = nominal.position_mm if nominal else [*position[:2], abs(position[2])]
            total += float(np.linalg.norm(position - np.array(meant)))
        return total

    return min(find_board_symmetries(rig.board(target[1])), key=total_displacement)


def find_rig_from_root(
    rig: Rig,
    root_from_camera: Mapping[str, RigidTransform],
    root_from_board: Mapping[Target, RigidTransform],
) -> RigidTransform:
    """Transform from the joint solve's root frame to the rig frame.

    Raises BadInput if the board or pair that should fix the frame was not seen or calibrated.
    """
    target, pair = find_frame_target(rig), rig.frame_pair
    if target is not None:
        if target not in root_from_board:
            raise BadInput(
                f"the rig frame is fixed by board {target[1]} in shot {target[0]}, "
                "but no calibrated pair sees it there",
                where=f"rig {rig.name}",
                remedy="capture that shot again so that a camera sees the board, or fix the frame "
                "by a pair (rig_frame: {pair: NAME})",
            )
        frame = rig.rig_frame
        x, y = (np.array(axis) / np.linalg.norm(axis) for axis in (frame.x_axis, frame.y_axis))
        axes = np.column_stack([x, y, np.cross(x, y)])
        rig_from_board = RigidTransform(axes, np.array(frame.origin_mm))
        return rig_from_board @ root_from_board[target].inverse()
    assert pair is not None
    return _place_at_nominal_pose(rig, pair, root_from_camera)


def rig_from_world(
    rig: Rig, world_from_camera: Mapping[str, RigidTransform]
) -> RigidTransform | None:
    """Transform from the frame of cameras that another program placed to the rig frame.

    None if the rig file does not give the pose of the pair that holds it. Raises BadInput if that
    pair is not among them.
    """
    pair = rig.frame_pair
    if pair is None or (rig.rig_frame.pair is None and pair.nominal is None):
        return None
    return _place_at_nominal_pose(rig, pair, world_from_camera, "imported", "its `known`")


def _place_at_nominal_pose(
    rig: Rig,
    pair: Pair,
    from_camera: Mapping[str, RigidTransform],
    done: str = "calibrated",
    source: str = "that pair's captures",
) -> RigidTransform:
    """Transform that puts a pair at its nominal pose.

    done, source: for the error, how its pose was to be known and from what.
    """
    if pair.name not in from_camera:
        raise BadInput(
            f"the rig frame is fixed by pair {pair.name}, which could not be {done}",
            where=f"rig {rig.name}",
            remedy=f"correct {source}, or name another pair in rig_frame",
        )
    rig_from_camera = (
        compute_nominal_pose(pair.nominal) if pair.nominal else RigidTransform.identity()
    )
    return rig_from_camera @ from_camera[pair.name].inverse()
