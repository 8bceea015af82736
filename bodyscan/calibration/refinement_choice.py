"""Whether refining camera, boards and light sheets together is better, judged on held-out boards."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from bodyscan.calibration.boundary_points import BoundaryPoints, select
from bodyscan.calibration.camera import CameraCalibration
from bodyscan.calibration.joint_refinement import (
    JointFit,
    StripedBoard,
    refine_jointly,
)
from bodyscan.calibration.sheet_fit import fit_sheets
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.light_planes import LightSheets
from bodyscan.geometry.scaled_systems import solve_scaled
from bodyscan.geometry.smooth_sheets import SmoothSheets

FEWEST_BOARDS = 3
MOST_DRIFT = 24.3
"""Chi-squared of seven intrinsics exceeded once in a thousand: a board that is not flat, taken for
flat, pulls the camera away from what its corners say."""
FLATTEST_SHARE = 0.95


@dataclass(frozen=True, eq=False)
class Refinement:
    """joint: None where it was not taken.  reason: why it was taken or not.  flatness_mm: of held-out
    boards, RMS about their own planes, before and after; None if it was not tried.
    """

    joint: JointFit[SmoothSheets] | None
    reason: str
    flatness_mm: tuple[float, float] | None = None


def refine_where_better(
    calibration: CameraCalibration,
    sheets: LightSheets,
    boards: Sequence[StripedBoard],
    data: BoundaryPoints,
) -> Refinement:
    """Refine jointly if that makes boards flatter that took no part with their stripes.

    boards: in the order of `data.board`; data: binned boundary points of the unrefined calibration.
    """
    if not isinstance(sheets, SmoothSheets):
        return Refinement(None, "free planes are not refined")
    if len(boards) < FEWEST_BOARDS:
        return Refinement(None, f"{len(boards)} boards with stripes are too few")
    poses = calibration.camera_from_board
    before, after = [], []
    for held in range(len(boards)):
        others = fit_sheets(sheets, select(data, data.board != held)).sheets
        before.append(_flatness(calibration.camera, others, boards[held]))
        partly = [
            replace(b, pixels=b.pixels[:0], index=b.index[:0], sigma_px=b.sigma_px[:0])
            if k == held
            else b
            for k, b in enumerate(boards)
        ]
        joint = refine_jointly(calibration.camera, poses, others, partly)
        after.append(_flatness(joint.camera, joint.sheets, boards[held]))
    was, now = float(np.sqrt(np.mean(np.square(before)))), float(np.sqrt(np.mean(np.square(after))))
    if not now < FLATTEST_SHARE * was:
        return Refinement(None, "held-out boards did not become flatter", (was, now))
    joint = refine_jointly(calibration.camera, poses, sheets, boards)
    drift = _drift(calibration, joint.camera)
    if drift > MOST_DRIFT:
        return Refinement(None, f"it contradicts the corners (chi-squared {drift:.0f})", (was, now))
    return Refinement(joint, "held-out boards became flatter", (was, now))


def _flatness(camera: Camera, sheets: LightSheets, board: StripedBoard) -> float:
    """RMS (mm) of the board's boundary points about their own best plane, outliers aside."""
    rays = camera.rays(board.pixels)
    points = rays * sheets.depth(rays, board.index)[:, None]
    points = points[np.isfinite(points[:, 0])]
    for _ in range(3):
        centred = points - points.mean(axis=0)
        normal = np.linalg.eigh(centred.T @ centred)[1][:, 0]
        off = np.abs(centred @ normal)
        points = points[off <= max(6.0 * float(np.median(off)), 1e-9)]
    centred = points - points.mean(axis=0)
    return float(np.sqrt(np.linalg.eigvalsh(centred.T @ centred)[0] / len(centred)))


def _drift(calibration: CameraCalibration, camera: Camera) -> float:
    """Squared distance of the refined intrinsics in the covariance that the corners gave them."""
    change = camera.parameters - calibration.camera.parameters
    return float(change @ solve_scaled(calibration.covariance, change))
