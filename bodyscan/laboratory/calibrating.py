"""Calibrate every approach of section 4.2 and ours from the same images."""

from __future__ import annotations

from dataclasses import dataclass

from bodyscan.arrays import Array
from bodyscan.calibration.board_views import planar_view
from bodyscan.calibration.boundary_points import BIN_PX, select, subsample
from bodyscan.calibration.camera import CameraCalibration
from bodyscan.calibration.joint_refinement import StripedBoard, refine_jointly
from bodyscan.calibration.light_sheets import fit_light_sheets
from bodyscan.calibration.sheet_fit import PlaneFit, fit_light_planes
from bodyscan.geometry.light_planes import SmoothSheets
from bodyscan.laboratory import apparatus
from bodyscan.laboratory.approaches import (
    PROJECTORS,
    Approach,
    LocatedBoards,
    calibrate_by_matrix,
    calibrate_by_reference_plane,
    calibrate_by_slide_stage,
    fit_approach,
    free_planes,
    locate_boards,
    locate_boundaries,
    pinhole_planes,
    remapped_planes,
)
from bodyscan.laboratory.chapter_captures import ChapterCaptures


@dataclass(frozen=True, eq=False)
class Calibrations:
    """Everything calibrated from the same images.

    reference: Zhang's camera.
    planes: the chapter's fit of its free planes.
    ours: our approach, with the camera of the joint solve.
    model, refinement: what ours chose.
    approaches: (i), (i) mended, (ii), (ii) with skew, (iii), ours.
    by_stage, by_reference: every model of the projector, calibrated either way.
    """

    reference: CameraCalibration
    planes: PlaneFit
    ours: Approach
    camera_covariance: Array
    model: str
    refinement: str
    approaches: tuple[Approach, ...]
    by_stage: tuple[Approach, ...]
    by_reference: tuple[Approach, ...]


def calibrate_all(captures: ChapterCaptures) -> Calibrations:
    """Calibrate everything that is compared, from the same shots."""
    reference, reference_boards = calibrate_by_reference_plane(captures.boards)
    _, stage = calibrate_by_slide_stage(captures.stage, captures.readings)
    _, skewed = calibrate_by_slide_stage(captures.stage, captures.readings, skewed=True)
    projector = apparatus.PROJECTOR
    planes = fit_light_planes(reference_boards.points, projector.stripes, projector.direction)
    ours, covariance, model, refinement = calibrate_ours(captures, reference, reference_boards)
    by_matrix = calibrate_by_matrix(captures.stage, captures.readings)
    second, with_skew = (
        locate_boards(captures.boards, boards.camera) for boards in (stage, skewed)
    )
    approaches = (
        # 3 x 4 and 2 x 4 matrices from the stage, no lens, the index taken as linear.
        fit_approach("(i)", by_matrix, pinhole_planes),
        # Tsai's camera with its lens, and a re-mapped index.
        fit_approach("(i) mended", stage, remapped_planes),
        # Tsai's camera from the stage, planes from the reference plane: the chapter's text, not its
        # heading `calibrated by slide stage`.
        fit_approach("(ii)", second, free_planes),
        fit_approach("(ii) with skew", with_skew, free_planes),
        Approach("(iii)", reference_boards.camera, planes.planes),
        ours,
    )
    return Calibrations(
        reference,
        planes,
        ours,
        covariance,
        model,
        refinement,
        approaches,
        tuple(fit_approach(name, stage, model) for name, model in PROJECTORS.items()),
        tuple(fit_approach(name, reference_boards, model) for name, model in PROJECTORS.items()),
    )


def calibrate_ours(
    captures: ChapterCaptures, reference: CameraCalibration, boards: LocatedBoards
) -> tuple[Approach, Array, str, str]:
    """Calibrate as `bodyscan calibrate-rig` does for a single pair: the light model that held-out
    boards choose, and a joint solve of corners and stripes."""
    projector, board = apparatus.PROJECTOR, apparatus.BOARD
    bins = locate_boundaries(
        captures.boards, boards.camera, boards.camera_from_board, bin_px=BIN_PX
    ).points
    data = subsample(bins, 6000)
    fit = fit_light_sheets(bins, projector.stripes, projector.direction)
    if not isinstance(fit.sheets, SmoothSheets):
        approach = Approach("ours", boards.camera, fit.sheets)
        return approach, reference.covariance, fit.model, "corners, then stripes"
    striped = [
        StripedBoard.from_points(
            board.name,
            planar_view(shot.view, board),
            boards.camera,
            select(data, data.board == number),
        )
        for number, shot in enumerate(captures.boards)
    ]
    flatness = {board.name: board.flatness_sigma_mm}
    refined = refine_jointly(boards.camera, reference.poses, fit.sheets, striped, flatness)
    approach = Approach("ours", refined.camera, refined.sheets)
    return approach, refined.camera_covariance, fit.model, "joint solve"
