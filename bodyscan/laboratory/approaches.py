"""The chapter's ways to calibrate a pair (4.2), and ours, all as a camera and light sheets.

With a reference plane held anywhere or on a slide stage: both give a camera, and stripe boundaries
at known points in its frame, to which every model of the projector is fitted.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np

from bodyscan.arrays import Array
from bodyscan.calibration.board_views import PlanarView, make_planar_view
from bodyscan.calibration.boundary_points import (
    BIN_PX,
    BoundaryPoints,
    compute_box,
    concatenate,
    on_board,
    select,
    select_boundaries_near,
    subsample,
)
from bodyscan.calibration.camera import CameraCalibration, calibrate_camera, locate_board
from bodyscan.calibration.joint_refinement import BoardStripes, StripedBoard, refine_jointly
from bodyscan.calibration.sheet_fit import PlaneFit, fit_light_planes, fit_pinhole
from bodyscan.calibration.sheet_selection import fit_light_sheets
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.light_planes import Axis, LightPlanes, LightSheets, SmoothSheets
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.laboratory.apparatus import BOARD, CAMERA, PROJECTOR, ChapterCaptures, StripedShot
from bodyscan.laboratory.rivals import (
    calibrate_tsai,
    estimate_projection_matrix,
    fit_baseline,
    fit_remapped_pinhole,
    split_projection_matrix,
)


@dataclass(frozen=True, eq=False)
class LocatedBoards:
    """A camera, camera_from_board of each shot, and the boundaries on the boards, camera frame."""

    camera: Camera
    camera_from_board: Sequence[RigidTransform]
    points: BoundaryPoints


def calibrate_by_reference_plane(
    shots: Sequence[StripedShot],
) -> tuple[CameraCalibration, LocatedBoards]:
    """Calibrate by Zhang's method (section 3), which also gives the boards' poses."""
    found = calibrate_camera(_make_planar_views(shots), CAMERA.width, CAMERA.height)
    return found, locate_boundaries(shots, found.camera, found.poses)


def calibrate_by_slide_stage(
    shots: Sequence[StripedShot], readings: Array, *, skewed: bool = False
) -> LocatedBoards:
    """Calibrate Tsai's camera, with a skew if wanted, from a board slid along its normal.

    readings: (shots,) mm, of the stage.
    """
    camera, camera_from_stage = calibrate_tsai(
        *_stack_stage_points(shots, readings), CAMERA.width, CAMERA.height, skewed=skewed
    )
    return locate_boundaries(shots, camera, _compute_stage_poses(camera_from_stage, readings))


def calibrate_by_matrix(shots: Sequence[StripedShot], readings: Array) -> LocatedBoards:
    """Calibrate a 3 x 4 camera without a lens from the stage (Bolles et al. 1981).

    The stripes' positions are read off each board by its own homography, which has no lens either.
    """
    matrix = estimate_projection_matrix(*_stack_stage_points(shots, readings))
    camera, camera_from_stage = split_projection_matrix(matrix, CAMERA.width, CAMERA.height)
    poses = _compute_stage_poses(camera_from_stage, readings)
    # The same test of what lies on the checkered area as for every other model.
    points = locate_boundaries(shots, camera, poses).points
    parts = [
        _read_by_homography(select(points, points.board == number), camera, view, pose)
        for number, (view, pose) in enumerate(zip(_make_planar_views(shots), poses, strict=True))
    ]
    return LocatedBoards(camera, poses, concatenate(parts))


def locate_boards(shots: Sequence[StripedShot], camera: Camera) -> LocatedBoards:
    """Locate boards held anywhere with a camera that is already known."""
    poses = [locate_board(camera, view)[0] for view in _make_planar_views(shots)]
    return locate_boundaries(shots, camera, poses)


def locate_boundaries(
    shots: Sequence[StripedShot],
    camera: Camera,
    camera_from_board: Sequence[RigidTransform],
    *,
    bin_px: int = 1,
) -> LocatedBoards:
    """Project stripe boundaries onto boards of known pose (Eq. 18), singly or binned."""
    parts = [
        on_board(
            camera,
            PROJECTOR,
            BOARD,
            pose,
            select_boundaries_near(shot.stripes, compute_box(shot.view)),
            number,
            bin_px=bin_px,
        )
        for number, (shot, pose) in enumerate(zip(shots, camera_from_board, strict=True))
    ]
    return LocatedBoards(camera, camera_from_board, concatenate(parts))


def _make_planar_views(shots: Sequence[StripedShot]) -> list[PlanarView]:
    return [make_planar_view(shot.view, BOARD) for shot in shots]


def _stack_stage_points(shots: Sequence[StripedShot], readings: Array) -> tuple[Array, Array]:
    """Stack all corners (N, 3) mm, frame of the board at reading 0, and their pixels (N, 2)."""
    views = _make_planar_views(shots)
    points = [
        view.points + [0.0, 0.0, reading] for view, reading in zip(views, readings, strict=True)
    ]
    return np.concatenate(points), np.concatenate([view.pixels for view in views])


def _compute_stage_poses(
    camera_from_stage: RigidTransform, readings: Array
) -> list[RigidTransform]:
    return [
        camera_from_stage @ RigidTransform.from_translation([0.0, 0.0, reading])
        for reading in readings.tolist()
    ]


def _read_by_homography(
    points: BoundaryPoints, camera: Camera, view: PlanarView, camera_from_board: RigidTransform
) -> BoundaryPoints:
    """Locate a board's boundaries on it by the homography of its corners alone."""
    onto_board = np.linalg.inv(cv2.findHomography(view.points[:, :2], view.pixels, 0)[0])

    def onto_plane(pixels: Array) -> Array:
        flat = cv2.perspectiveTransform(pixels[None], onto_board)[0]
        return camera_from_board.apply(np.column_stack([flat, np.zeros(len(flat))]))

    pixels, half = camera.project(points.points), np.array([0.5, 0.0])
    per_pixel = onto_plane(pixels + half) - onto_plane(pixels - half)
    return replace(points, points=onto_plane(pixels), per_pixel=per_pixel)


@dataclass(frozen=True, eq=False)
class Approach:
    """A calibrated pair as needed for triangulation, whatever the models."""

    name: str
    camera: Camera
    sheets: LightSheets


Model = Callable[[BoundaryPoints, int, Axis], LightPlanes]


def fit_free_planes(points: BoundaryPoints, stripes: int, direction: Axis) -> LightPlanes:
    """Fit one free plane per stripe (Eq. 6)."""
    return fit_light_planes(points, stripes, direction).planes


def fit_pinhole_planes(points: BoundaryPoints, stripes: int, direction: Axis) -> LightPlanes:
    """Fit the 2 x 4 matrix of Bolles et al. 1981."""
    few = subsample(points, 20_000)
    above, below = fit_pinhole(few.points, few.index.astype(float))
    return LightPlanes.from_planes(above - np.arange(stripes + 1.0)[:, None] * below, direction)


def fit_remapped_planes(points: BoundaryPoints, stripes: int, direction: Axis) -> LightPlanes:
    """Fit the 2 x 4 matrix with a re-mapped index."""
    few = subsample(points, 20_000)
    return fit_remapped_pinhole(few.points, few.index.astype(float), stripes, direction)


PROJECTORS: dict[str, Model] = {
    "2 x 4 matrix": fit_pinhole_planes,
    "2 x 4 matrix, index re-mapped": fit_remapped_planes,
    "invariable baseline": partial(fit_baseline, variable=False, fit_tilt=False),
    "invariable baseline, tilted": partial(fit_baseline, variable=False),
    "variable baseline": partial(fit_baseline, variable=True, fit_tilt=False),
    "variable baseline, tilted": partial(fit_baseline, variable=True),
    "free planes": fit_free_planes,
}
"""Every model of the projector that the chapter names. `tilted`: the baseline's direction in the
image is estimated too, instead of being assumed to be the camera's x axis."""


def fit_approach(name: str, where: LocatedBoards, model: Model) -> Approach:
    """Fit one model of the projector to boundaries at known points."""
    sheets = model(where.points, PROJECTOR.stripes, PROJECTOR.direction)
    return Approach(name, where.camera, sheets)


@dataclass(frozen=True, eq=False)
class Calibrations:
    """Everything calibrated from the same images."""

    reference: CameraCalibration  # Zhang's camera
    planes: PlaneFit  # the chapter's fit of its free planes
    ours: Approach  # our approach, with the camera of the joint solve
    camera_covariance: Array
    model: str  # of its light sheets, as held-out boards chose
    approaches: tuple[Approach, ...]  # (i), (i) mended, (ii), (ii) with skew, (iii), ours
    # by_stage, by_reference: every model of the projector, calibrated either way.
    by_stage: tuple[Approach, ...]
    by_reference: tuple[Approach, ...]


def calibrate_all(captures: ChapterCaptures) -> Calibrations:
    """Calibrate everything that is compared, from the same shots."""
    reference, reference_boards = calibrate_by_reference_plane(captures.boards)
    stage = calibrate_by_slide_stage(captures.stage, captures.readings)
    skewed = calibrate_by_slide_stage(captures.stage, captures.readings, skewed=True)
    by_matrix = calibrate_by_matrix(captures.stage, captures.readings)
    planes = fit_light_planes(reference_boards.points, PROJECTOR.stripes, PROJECTOR.direction)
    ours, covariance, model = calibrate_ours(captures, reference, reference_boards)
    second, with_skew = (
        locate_boards(captures.boards, boards.camera) for boards in (stage, skewed)
    )
    approaches = (
        # 3 x 4 and 2 x 4 matrices from the stage, no lens, the index taken as linear.
        fit_approach("(i)", by_matrix, fit_pinhole_planes),
        # Tsai's camera with its lens, and a re-mapped index.
        fit_approach("(i) mended", stage, fit_remapped_planes),
        # Tsai's camera from the stage, planes from the reference plane: the chapter's text, not its
        # heading `calibrated by slide stage`.
        fit_approach("(ii)", second, fit_free_planes),
        fit_approach("(ii) with skew", with_skew, fit_free_planes),
        Approach("(iii)", reference_boards.camera, planes.planes),
        ours,
    )
    by_stage, by_reference = (
        tuple(fit_approach(name, boards, model) for name, model in PROJECTORS.items())
        for boards in (stage, reference_boards)
    )
    return Calibrations(
        reference, planes, ours, covariance, model, approaches, by_stage, by_reference
    )


def calibrate_ours(
    captures: ChapterCaptures, reference: CameraCalibration, boards: LocatedBoards
) -> tuple[Approach, Array, str]:
    """Calibrate as `bodyscan calibrate-rig` does for a single pair: the light model that held-out
    boards choose, and a joint solve of corners and stripes if that model is smooth.

    Returns also the covariance (P, P) of the camera's parameters, and the model's name.
    """
    shots, camera = captures.boards, boards.camera
    bins = locate_boundaries(shots, camera, boards.camera_from_board, bin_px=BIN_PX).points
    fit = fit_light_sheets(bins, PROJECTOR.stripes, PROJECTOR.direction)
    if not isinstance(fit.sheets, SmoothSheets):
        return Approach("ours", camera, fit.sheets), reference.covariance, fit.model
    data = subsample(bins, 6000)
    striped = [
        StripedBoard(
            BOARD.name,
            view,
            (BoardStripes.from_points(camera, select(data, data.board == number)),),
        )
        for number, view in enumerate(_make_planar_views(shots))
    ]
    flatness = {BOARD.name: BOARD.flatness_sigma_mm}
    refined = refine_jointly(camera, reference.poses, [fit.sheets], striped, flatness)
    approach = Approach("ours", refined.camera, *refined.sheets)
    return approach, refined.camera_covariance, fit.model
