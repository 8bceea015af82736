"""How the rig frame is fixed: by a board in one shot, or by one pair at its nominal placing."""

from __future__ import annotations

import numpy as np

from bodyscan.capture.rig import Placing, Rig
from bodyscan.errors import BadInput
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.registration.view_graph import Target


def nominal_placing(placing: Placing) -> RigidTransform:
    """`rig_from_camera` of a camera that looks from one point at another, upright."""
    position = np.array(placing.position_mm)
    forward = np.array(placing.look_at_mm) - position
    forward /= np.linalg.norm(forward)
    up = np.array([0.0, 0.0, 1.0]) if abs(forward[2]) < 0.999 else np.array([1.0, 0.0, 0.0])
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    return RigidTransform(np.column_stack([right, np.cross(forward, right), forward]), position)


def frame_target(rig: Rig) -> Target | None:
    """The (shot, board) that fixes the rig frame, or None if a pair does."""
    board, shot = rig.frame_board, rig.rig_frame.shot
    return (shot, board.name) if board and shot else None


def rig_from_root(
    rig: Rig,
    root_from_camera: dict[str, RigidTransform],
    root_from_board: dict[Target, RigidTransform],
) -> RigidTransform:
    """Carries the joint solve's root frame into the rig frame.

    Raises BadInput if the board or pair that should fix the frame was not seen or calibrated.
    """
    target, pair = frame_target(rig), rig.frame_pair
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
    if pair.name not in root_from_camera:
        raise BadInput(
            f"the rig frame is fixed by pair {pair.name}, which could not be calibrated",
            where=f"rig {rig.name}",
            remedy="mend that pair's captures, or name another pair in rig_frame",
        )
    placed = nominal_placing(pair.nominal) if pair.nominal else RigidTransform.identity()
    return placed @ root_from_camera[pair.name].inverse()
