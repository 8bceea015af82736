"""A pair within the joint solve: the input for fitting its light sheets, and its poses afterwards."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from bodyscan.boards.view import ViewKey
from bodyscan.calibration.board_views import LocatedView, PlanarView
from bodyscan.calibration.camera import CameraCalibration, locate_board
from bodyscan.calibration.pair import LocatedPair, PairCalibration
from bodyscan.calibration.striped_view import BoardBoundaries, StripedView
from bodyscan.registration.rig_frame import frame_target
from bodyscan.registration.rig_solve import RigSolution
from bodyscan.rig.rig import Rig


def solved_view(
    rig: Rig, solution: RigSolution, view: LocatedView, boundaries: BoardBoundaries
) -> StripedView:
    """A view with its stripes, and with the pose and shape of its board from the joint solve."""
    shape = solution.board_shapes.get(view.board)
    face = shape.face(view.points) if shape else None
    return StripedView(_with_pose(solution, view), rig.board(view.board), boundaries, face)


def _with_pose(solution: RigSolution, view: LocatedView) -> LocatedView:
    camera_from_rig = solution.rig_from_camera[view.pair].inverse()
    return replace(view, camera_from_board=camera_from_rig @ solution.rig_from_board[view.target])


def solved_pair(
    rig: Rig,
    solution: RigSolution,
    name: str,
    single: CameraCalibration,
    boundaries: Mapping[ViewKey, BoardBoundaries],
) -> LocatedPair:
    """A pair with the camera and boards of the joint solve.

    single: its camera as calibrated by itself.
    boundaries: of stripes on the boards, by view; views without any take part with their corners.
    """
    views = [view for view in solution.views if view.pair == name]
    return LocatedPair(
        name,
        solution.cameras[name],
        solution.camera_covariances.get(name, single.covariance),
        solution.rays.get(name, single.rays),
        solution.lenses.get(name, single.lenses),
        solution.rms_px[name],
        rig.pair(name).projector,
        tuple(_with_pose(solution, view) for view in views),
        tuple(
            solved_view(rig, solution, view, boundaries[view.key])
            for view in views
            if view.key in boundaries
        ),
        rig.boards,
        alone=len(solution.cameras) == 1,
    )


def update_poses(rig: Rig, solution: RigSolution, pair: PairCalibration) -> RigSolution:
    """Locate the boards again by a pair's camera, where its stripes refined that.

    The board that fixes the rig frame stays where it is, or else the camera. Only a pair by itself is
    refined by its stripes.
    """
    if pair.camera == solution.cameras[pair.name]:
        return solution
    camera_from_board = {
        view.target: locate_board(pair.camera, PlanarView(view.shot, view.points, view.pixels))[0]
        for view in solution.views
    }
    frame = frame_target(rig)
    rig_from_camera = (
        solution.rig_from_board[frame] @ camera_from_board[frame].inverse()
        if frame in camera_from_board
        else solution.rig_from_camera[pair.name]
    )
    return replace(
        solution,
        cameras={pair.name: pair.camera},
        rig_from_camera={pair.name: rig_from_camera},
        rig_from_board={
            target: rig_from_camera @ pose for target, pose in camera_from_board.items()
        },
    )
