"""Calibrate one pair from boards of known pose: check its stripes, fit its light sheets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from bodyscan.arrays import Array
from bodyscan.calibration.board_views import LocatedView, PlanarView
from bodyscan.calibration.boundary_points import (
    BoundaryPoints,
    StripedView,
    locate_boundaries_on_boards,
    select,
    subsample,
)
from bodyscan.calibration.joint_refinement import BoardStripes, StripedBoard, refine_jointly
from bodyscan.calibration.lens_selection import LensTrial
from bodyscan.calibration.model_selection import HeldOutModel
from bodyscan.calibration.sheet_fit import fit_pinhole, fit_sheets
from bodyscan.calibration.sheet_selection import fit_light_sheets
from bodyscan.errors import PairFailed
from bodyscan.geometry.bowed_sheets import BowedSheets
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lens_sheets import LensSheets
from bodyscan.geometry.light_planes import Axis, LightSheets, SmoothSheets
from bodyscan.geometry.light_sheets import intersect_rays
from bodyscan.geometry.robust import rms
from bodyscan.geometry.uncertainty import RayUncertainty
from bodyscan.outcome import Outcome
from bodyscan.rig.board import Board
from bodyscan.stripes.stripe_code import StripeCode


@dataclass(frozen=True)
class PairQuality:
    """Figures of one pair.

    corners_rms_px: RMS error of corners, px; None if no board was seen.
    planes_rms_mm: RMS distance of boundary points from their sheets, mm.
    stripes_calibrated, stripes_projected: boundaries with a sheet, and all that are projected.
    held_out: every model of the light tried on held-out boards, simplest first.
    refinement: for a pair by itself, how camera, boards and light were solved for; "" if in turn.
    bent_mm: height from the lowest to the highest corner of each board, by that solve, mm.
    boards_mm: mean and RMS over the boards of the offset at which stripes measure them, relative to
        the corners of all cameras.
    lenses: every lens tried on held-out boards, simplest first; empty if the lens was given or the
        boards stood at too few positions.
    imported: the file of another program that the calibration was taken from, "" if it is our own.
    imported_sigma_px: sigma of its pixels, None if unknown.
    """

    corners_rms_px: float | None
    poses: int
    planes_rms_mm: float | None = None
    stripe_shots: int = 0
    stripes_calibrated: int = 0
    stripes_projected: int = 0
    held_out: tuple[HeldOutModel, ...] = ()
    refinement: str = ""
    bent_mm: dict[str, float] = field(default_factory=dict)
    boards_mm: tuple[float, float] | None = None
    lenses: tuple[LensTrial, ...] = ()
    imported: str = ""
    imported_sigma_px: float | None = None

    @property
    def unjudged(self) -> bool:
        """Whether nothing is known about its accuracy."""
        return bool(self.imported) and self.imported_sigma_px is None

    @property
    def light_model(self) -> str | None:
        """The model of the light that held-out boards chose."""
        if self.imported and self.stripes_projected:
            return "imported"
        return next((tried.model for tried in self.held_out if tried.chosen), None)


@dataclass(frozen=True, eq=False)
class PairCalibration:
    """A calibrated pair, camera frame."""

    name: str
    camera: Camera
    camera_covariance: Array  # of the camera's parameters, (P, P)
    sheets: LightSheets | None  # None for a camera without a projector
    quality: PairQuality
    # Sheets of the crossing stripes, None if there are none or they are not known.
    crossing: LightSheets | None = None
    rays: RayUncertainty | None = None


@dataclass(frozen=True, eq=False)
class LocatedPair:
    """A pair whose camera and boards are known: the input for fitting its light sheets."""

    name: str
    # camera, camera_covariance: the camera after the joint solve of the rig's corners, and the
    # covariance (P, P) of its parameters.
    camera: Camera
    camera_covariance: Array
    rays: RayUncertainty | None  # how well each pixel's ray is known
    lenses: tuple[LensTrial, ...]
    rms_px: float
    projector: StripeCode | None
    # Every board view that the camera contributed, with `camera_from_board` from that solve.
    views: tuple[LocatedView, ...]
    shots: tuple[StripedView, ...]  # those with decoded stripes
    boards: tuple[Board, ...]
    alone: bool  # whether no other pair constrains the boards


def calibrate_pair(pair: LocatedPair) -> Outcome[PairCalibration]:
    """Fit the light sheets of one pair. Raises PairFailed if its stripes do not give any."""
    calibration = PairCalibration(
        pair.name,
        pair.camera,
        pair.camera_covariance,
        None,
        PairQuality(pair.rms_px, len(pair.views), lenses=pair.lenses),
        rays=pair.rays,
    )
    code = pair.projector
    if code is None:
        return Outcome(calibration)
    shots, notes = pair.shots, list[str]()
    points = locate_boundaries_on_boards(pair.name, pair.camera, code, shots)
    odd = find_odd_board(points, code.stripes, code.direction)
    if odd is not None:
        number, rms_mm = odd
        notes.append(
            f"{pair.name}: the stripes of shot {shots[number].view.shot} do not fit the others', with "
            f"which the boards disagree by {rms_mm:.2g} mm, and are not used. Possible causes: the "
            "board or the projector moved during the sequence; images of several shots are mixed up"
        )
        shots = (*shots[:number], *shots[number + 1 :])
        points = locate_boundaries_on_boards(pair.name, pair.camera, code, shots)
    fit = fit_light_sheets(points, code.stripes, code.direction)
    offsets = compute_board_offsets(points, fit.sheets)
    quality = replace(
        calibration.quality,
        planes_rms_mm=fit.rms_mm,
        stripe_shots=len(shots),
        stripes_calibrated=fit.stripes_calibrated,
        stripes_projected=max(code.stripes - 1, 1),
        held_out=fit.held_out,
        boards_mm=(float(offsets.mean()), rms(offsets)) if offsets.size else None,
    )
    lights = [_Light(fit.sheets, shots, points)]
    crossing = _fit_crossing(pair, code, shots)
    if crossing.value is not None:
        lights.append(crossing.value)
    calibration = replace(calibration, sheets=fit.sheets, quality=quality)
    if pair.alone:
        # In a rig of several pairs all cameras together constrain the boards, far better than the
        # stripes of one pair could.
        calibration, lights = _refine(pair, calibration, lights)
    sheets, *across = (light.sheets for light in lights)
    return Outcome(
        replace(calibration, sheets=sheets, crossing=across[0] if across else None),
        (*notes, *crossing.notes),
    )


@dataclass(frozen=True, eq=False)
class _Light:
    """Sheets of one direction and what they were fitted to: shots, and their boundary points."""

    sheets: LightSheets
    shots: Sequence[StripedView]
    points: BoundaryPoints


def _refine(
    pair: LocatedPair, calibration: PairCalibration, lights: Sequence[_Light]
) -> tuple[PairCalibration, list[_Light]]:
    """Refine camera, boards and the sheets of both directions jointly, from all corners and a subset
    of the stripes. Sheets that are not smooth in s stay as they are."""
    smooth = [light for light in lights if isinstance(light.sheets, SmoothSheets)]
    if not smooth:
        return calibration, list(lights)
    faces = {shot.view.key: shot.face for light in lights for shot in light.shots}
    # 6000 bins determine camera, boards and sheets to a tenth as well as all bins do.
    points = [subsample(light.points, 6000) for light in smooth]
    number = [{shot.view.key: k for k, shot in enumerate(light.shots)} for light in smooth]

    def stripes_on(view: LocatedView) -> tuple[BoardStripes, ...]:
        return tuple(
            BoardStripes.from_points(pair.camera, select(some, some.board == k.get(view.key, -1)))
            for some, k in zip(points, number, strict=True)
        )

    boards = [
        StripedBoard(
            view.board,
            PlanarView(view.shot, view.points, view.pixels),
            stripes_on(view),
            faces.get(view.key),
        )
        for view in pair.views
    ]
    observed = {view.board for view in pair.views}
    joint = refine_jointly(
        pair.camera,
        [view.camera_from_board for view in pair.views],
        [light.sheets for light in smooth if isinstance(light.sheets, SmoothSheets)],
        boards,
        {board.name: board.flatness_sigma_mm for board in pair.boards if board.name in observed},
    )
    refined = iter(joint.sheets)
    quality = replace(
        calibration.quality,
        refinement="joint solve of corners and stripes",
        corners_rms_px=joint.corners_rms_px,
        bent_mm={name: warp.out_of_plane_mm for name, warp in joint.warps.items()},
    )
    return replace(
        calibration, camera=joint.camera, camera_covariance=joint.camera_covariance, quality=quality
    ), [replace(light, sheets=next(refined)) if light in smooth else light for light in lights]


def _fit_crossing(
    pair: LocatedPair, code: StripeCode, shots: Sequence[StripedView]
) -> Outcome[_Light | None]:
    """Fit sheets of the crossing stripes, if any were projected; if they give none, say so."""
    across = code.crossing
    if across is None:
        return Outcome(None)
    crossed = [
        replace(shot, boundaries=shot.boundaries.crossing)
        for shot in shots
        if shot.boundaries.crossing is not None
    ]
    try:
        points = locate_boundaries_on_boards(pair.name, pair.camera, across, crossed)
        fit = fit_light_sheets(points, across.stripes, across.direction)
    except PairFailed as error:
        return Outcome(None, (f"{pair.name}: crossing stripes are not used: {error.what}",))
    note = f"{pair.name}: crossing stripes: {fit.model}, {fit.rms_mm:.3f} mm from their sheets"
    return Outcome(_Light(fit.sheets, crossed, points), (note,))


MAX_DISAGREEMENT_PX = 0.4
MAX_DISAGREEMENT = 1e-3
"""Boards agree if their stripes lie so few pixels from common sheets, or if they measure the boards
so near their corners, as a share of their distance: that much a board's bend and its pose are off."""


def find_odd_board(data: BoundaryPoints, stripes: int, direction: Axis) -> tuple[int, float] | None:
    """Find the board without which the others agree on the light; None if all of them do.

    data: its `board` counts the shots. Of fewer than three boards nothing is known.

    Returns the board and by how many mm all of them disagree. Raises PairFailed if they do and leaving
    one out does not make the rest agree three times better, or leaves two, which agree on any light.
    """
    few = subsample(data, 1200)
    boards = np.unique(few.board)
    if len(boards) < 3:
        return None
    ratio, rms_mm = _measure_disagreement(few, stripes, direction)
    if ratio < 1.0:
        return None
    if len(boards) > 3:
        without = (select(few, few.board != board) for board in boards)
        ratios = [_measure_disagreement(rest, stripes, direction)[0] for rest in without]
        if min(ratios) < min(1.0, ratio / 3.0):
            return int(boards[np.argmin(ratios)]), rms_mm
    raise PairFailed(
        f"the light sheets of {len(boards)} boards disagree by {rms_mm:.2g} mm, and leaving "
        "out one does not help. Possible causes: the projector moved against its camera between them; "
        "images of several shots are mixed up; `stripes` or `direction` in the rig file is wrong",
        remedy="fasten the projector and capture the boards again, or delete the shots from before "
        "it moved; check that the lit image and the patterns of each shot belong together",
    )


def _measure_disagreement(
    data: BoundaryPoints, stripes: int, direction: Axis
) -> tuple[float, float]:
    """Compute by how much boards disagree with sheets fitted to all, relative to what is allowed, and
    as the RMS offset of the boards from their corners, mm.

    Medians over each board, signed, so that noise and uneven stripes are no disagreement. The sheets
    may bow, so that no kind of projector is mistaken for one that moved.
    """
    pinhole = fit_pinhole(data.points, data.index.astype(float))
    plain = LensSheets.from_matrix(pinhole, data.points.mean(axis=0), stripes, direction)
    fit = fit_sheets(BowedSheets.from_pinhole(plain, 1), data, max_steps=12)
    pixels = fit.distances_mm / np.linalg.norm(data.per_pixel, axis=1)
    rms_px = rms(np.array([np.median(pixels[data.board == k]) for k in np.unique(data.board)]))
    rms_mm = rms(compute_board_offsets(data, fit.sheets))
    allowed_mm = MAX_DISAGREEMENT * float(np.median(data.points[:, 2]))
    return min(rms_px / MAX_DISAGREEMENT_PX, rms_mm / allowed_mm), rms_mm


def compute_board_offsets(data: BoundaryPoints, sheets: LightSheets) -> Array:
    """Compute the offset (B,) mm of each board as the stripes measure it from its pose by corners.

    Median along the board's normal, positive away from the camera.
    """
    rays = data.points / data.points[:, 2:]
    depth = intersect_rays(sheets, rays, data.index.astype(float)).depth
    offset = (depth - data.points[:, 2]) * data.board_errors.facing
    known = np.isfinite(offset)
    offset, board = offset[known], data.board[known]
    return np.array([np.median(offset[board == k]) for k in np.unique(board)], np.float64)
