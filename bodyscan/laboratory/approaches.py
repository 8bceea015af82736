"""The chapter's ways to calibrate a pair (4.2), all as a camera and light sheets.

With a reference plane held anywhere or on a slide stage: both give a camera, and stripe boundaries
at known points in its frame, to which every model of the projector is fitted.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np

from bodyscan.arrays import Array
from bodyscan.boards.view import BoardView
from bodyscan.calibration.board_views import PlanarView, planar_view
from bodyscan.calibration.boundary_points import (
    BoundaryPoints,
    boundaries_near,
    box_around,
    concatenate,
    on_board,
    subsample,
)
from bodyscan.calibration.camera import CameraCalibration, calibrate_camera, locate_board
from bodyscan.calibration.sheet_fit import fit_light_planes, fit_pinhole
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.light_planes import Axis, LightPlanes, LightSheets
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.laboratory.apparatus import BOARD, PROJECTOR
from bodyscan.laboratory.rival_cameras import (
    TsaiCamera,
    calibrate_tsai,
    projection_matrix,
    split_projection_matrix,
)
from bodyscan.laboratory.rival_projectors import fit_baseline, fit_remapped_pinhole
from bodyscan.stripes.stripe_map import StripeMap


@dataclass(frozen=True, eq=False)
class StripedShot:
    """One board in one shot: its corners, and the stripes that fell on it."""

    view: BoardView
    stripes: StripeMap


@dataclass(frozen=True, eq=False)
class LocatedBoards:
    """A camera, camera_from_board by shot, and the boundaries on the boards, camera frame."""

    camera: Camera
    camera_from_board: dict[str, RigidTransform]
    points: BoundaryPoints


def calibrate_by_reference_plane(
    shots: Sequence[StripedShot],
) -> tuple[CameraCalibration, LocatedBoards]:
    """Calibrate by Zhang's method (section 3), which also gives the boards' poses."""
    height, width = shots[0].stripes.s.shape
    views = [planar_view(shot.view, BOARD) for shot in shots]
    found = calibrate_camera(views, width, height)
    poses = {view.shot: pose for view, pose in zip(views, found.poses, strict=True)}
    return found, locate_boundaries(shots, found.camera, poses)


def calibrate_by_slide_stage(
    shots: Sequence[StripedShot], readings: Array, *, skewed: bool = False
) -> tuple[TsaiCamera, LocatedBoards]:
    """Calibrate Tsai's camera, with a skew if wanted, from a board slid along its normal.

    readings: (shots,) mm, of the stage.
    """
    height, width = shots[0].stripes.s.shape
    points, pixels = stage_points(shots, readings)
    middle = np.array([(width - 1) / 2.0, (height - 1) / 2.0])
    tsai = calibrate_tsai(points, pixels, middle, skewed=skewed)
    poses = {
        shot.view.shot: tsai.camera_from_points @ _stage_pose(float(reading))
        for shot, reading in zip(shots, readings, strict=True)
    }
    return tsai, locate_boundaries(shots, tsai.camera(width, height), poses)


def calibrate_by_matrix(shots: Sequence[StripedShot], readings: Array) -> LocatedBoards:
    """Calibrate a 3 x 4 camera without a lens from the stage (Bolles et al. 1981).

    The stripes' positions are read off each board by its own homography, which has no lens either.
    """
    height, width = shots[0].stripes.s.shape
    points, pixels = stage_points(shots, readings)
    matrix = projection_matrix(points, pixels)
    camera, camera_from_stage = split_projection_matrix(matrix, width, height)
    poses, parts = {}, []
    for number, (shot, reading) in enumerate(zip(shots, readings, strict=True)):
        pose = camera_from_stage @ _stage_pose(float(reading))
        poses[shot.view.shot] = pose
        view = planar_view(shot.view, BOARD)
        parts.append(_locate_by_homography(shot, view, camera, pose, number))
    return LocatedBoards(camera, poses, concatenate(parts))


def locate_boards(shots: Sequence[StripedShot], camera: Camera) -> LocatedBoards:
    """Locate boards held anywhere with a camera that is already known."""
    poses = {
        shot.view.shot: locate_board(camera, planar_view(shot.view, BOARD))[0] for shot in shots
    }
    return locate_boundaries(shots, camera, poses)


def locate_boundaries(
    shots: Sequence[StripedShot],
    camera: Camera,
    camera_from_board: dict[str, RigidTransform],
    *,
    bin_px: int = 1,
) -> LocatedBoards:
    """Project stripe boundaries onto boards of known pose (Eq. 18), singly or binned."""
    parts = [
        on_board(
            camera,
            PROJECTOR,
            BOARD,
            camera_from_board[shot.view.shot],
            boundaries_near(shot.stripes, box_around(shot.view)),
            number,
            bin_px=bin_px,
        )
        for number, shot in enumerate(shots)
    ]
    return LocatedBoards(camera, camera_from_board, concatenate(parts))


def stage_points(shots: Sequence[StripedShot], readings: Array) -> tuple[Array, Array]:
    """Stack all corners (N, 3) mm, frame of the board at reading 0, and their pixels (N, 2)."""
    views = [planar_view(shot.view, BOARD) for shot in shots]
    points = [
        view.points + [0.0, 0.0, reading] for view, reading in zip(views, readings, strict=True)
    ]
    return np.concatenate(points), np.concatenate([view.pixels for view in views])


def _stage_pose(reading: float) -> RigidTransform:
    return RigidTransform.from_translation([0.0, 0.0, reading])


def _locate_by_homography(
    shot: StripedShot,
    view: PlanarView,
    camera: Camera,
    camera_from_board: RigidTransform,
    number: int,
) -> BoundaryPoints:
    """Locate a board's boundaries on it by the homography of its corners alone."""
    near = boundaries_near(shot.stripes, box_around(shot.view))
    onto_board = np.linalg.inv(cv2.findHomography(view.points[:, :2], view.pixels, 0)[0])

    def onto_plane(pixels: Array) -> Array:
        image = np.column_stack([pixels, np.ones(len(pixels))]) @ onto_board.T
        flat = np.column_stack([image[:, :2] / image[:, 2:], np.zeros(len(image))])
        return camera_from_board.apply(flat)

    # The same test of what lies on the checkered area as for every other model.
    everything = on_board(camera, PROJECTOR, BOARD, camera_from_board, near, number, bin_px=1)
    pixels = camera.project(everything.points)
    horizontal = PROJECTOR.direction == "horizontal"
    across = np.array([0.0, 0.5]) if horizontal else np.array([0.5, 0.0])
    return BoundaryPoints(
        everything.index,
        everything.board,
        onto_plane(pixels),
        onto_plane(pixels + across) - onto_plane(pixels - across),
        everything.sigma_px,
    )


@dataclass(frozen=True, eq=False)
class Approach:
    """A calibrated pair as needed for triangulation, whatever the models."""

    name: str
    camera: Camera
    sheets: LightSheets


Model = Callable[[BoundaryPoints, int, Axis], LightPlanes]


def free_planes(points: BoundaryPoints, stripes: int, direction: Axis) -> LightPlanes:
    """Fit one free plane per stripe (Eq. 6)."""
    return fit_light_planes(points, stripes, direction).planes


def pinhole_planes(points: BoundaryPoints, stripes: int, direction: Axis) -> LightPlanes:
    """Fit the 2 x 4 matrix of Bolles et al. 1981."""
    few = subsample(points, 20_000)
    above, below = fit_pinhole(few.points, few.index.astype(float))
    return LightPlanes.from_planes(above - np.arange(stripes + 1.0)[:, None] * below, direction)


def remapped_planes(points: BoundaryPoints, stripes: int, direction: Axis) -> LightPlanes:
    """Fit the 2 x 4 matrix with a re-mapped index."""
    few = subsample(points, 20_000)
    return fit_remapped_pinhole(few.points, few.index.astype(float), stripes, direction)


PROJECTORS: dict[str, Model] = {
    "2 x 4 matrix": pinhole_planes,
    "2 x 4 matrix, index re-mapped": remapped_planes,
    "invariable baseline": partial(fit_baseline, variable=False, fit_tilt=False),
    "invariable baseline, tilted": partial(fit_baseline, variable=False),
    "variable baseline": partial(fit_baseline, variable=True, fit_tilt=False),
    "variable baseline, tilted": partial(fit_baseline, variable=True),
    "free planes": free_planes,
}
"""Every model of the projector that the chapter names. `tilted`: the baseline's direction in the
image is estimated too, instead of being assumed to be the camera's x axis."""


def fit_approach(name: str, where: LocatedBoards, model: Model) -> Approach:
    """Fit one model of the projector to boundaries at known points."""
    sheets = model(where.points, PROJECTOR.stripes, PROJECTOR.direction)
    return Approach(name, where.camera, sheets)
