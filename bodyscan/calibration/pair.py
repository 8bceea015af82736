"""Calibrate one pair from boards of known pose: check its stripes, fit its light sheets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from bodyscan.arrays import Array
from bodyscan.calibration.board_views import PlanarView
from bodyscan.calibration.boundary_points import BoundaryPoints, subsample
from bodyscan.calibration.camera import CameraCalibration, LensTrial
from bodyscan.calibration.joint_refinement import striped_board
from bodyscan.calibration.light_sheets import fit_light_sheets
from bodyscan.calibration.model_selection import HeldOutModel
from bodyscan.calibration.refinement_choice import (
    REFINED_BINS,
    RefinementTrial,
    refine_where_better,
)
from bodyscan.calibration.stripe_agreement import (
    ProjectorMotion,
    board_offsets,
    find_projector_motion,
)
from bodyscan.calibration.striped_view import StripedView, boundaries_on_boards
from bodyscan.errors import PairFailed
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.light_planes import LightSheets
from bodyscan.geometry.uncertainty import RayUncertainty
from bodyscan.outcome import Outcome
from bodyscan.stripes.stripe_code import StripeCode


@dataclass(frozen=True)
class PairQuality:
    """Figures of one pair.

    corners_rms_px: RMS error of corners, px; None if no board was seen.
    poses: number of board poses.
    planes_rms_mm: RMS distance of boundary points from their sheets, mm.
    stripe_shots: number of boards with stripes.
    stripes_calibrated, stripes_projected: boundaries with a sheet, and all that are projected.
    held_out: every model of the light tried on held-out boards, simplest first.
    refinement: for a pair by itself, whether camera, boards and light were refined together and
        why.
    flatness_mm: RMS distance of held-out boards' stripes from the boards, before refinement and as
        chosen.
    ways: every refinement tried on held-out boards.
    bent_mm: height from the lowest to the highest corner of each board found to be bent, mm.
    boards_mm: mean and RMS over the boards of the offset at which stripes measure them, relative to
        where the corners of all cameras put them.
    lenses: every lens tried on held-out boards, simplest first; empty if the lens was given or the
        boards stood in too few places.
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
    flatness_mm: tuple[float, float] | None = None
    ways: tuple[RefinementTrial, ...] = ()
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
    """A calibrated pair, camera frame.

    camera_covariance: covariance of the camera's parameters, (P, P).
    sheets: None for a camera without a projector.
    crossing: sheets of the crossing stripes, None if there are none or they are not known.
    rays: how well each pixel's ray is known; None if that was not computed.
    """

    name: str
    camera: Camera
    camera_covariance: Array
    sheets: LightSheets | None
    quality: PairQuality
    crossing: LightSheets | None = None
    rays: RayUncertainty | None = None


@dataclass(frozen=True, eq=False)
class PlacedPair:
    """A pair whose camera and boards are known: the input for fitting its light sheets.

    camera, camera_covariance: the camera after the joint solve of the rig's corners, and the
        covariance (P, P) of its parameters.
    own: the camera as calibrated by itself.
    lenses: those that were tried.
    views: number of board views that it contributed.
    shots: those with decoded stripes, with `camera_from_board` from the joint solve.
    alone: whether no other pair fixes the boards.
    rays: how well each pixel's ray is known.
    """

    name: str
    camera: Camera
    camera_covariance: Array
    own: CameraCalibration
    lenses: tuple[LensTrial, ...]
    projector: StripeCode | None
    rms_px: float
    views: int
    shots: tuple[StripedView, ...]
    alone: bool
    rays: RayUncertainty | None = None


def calibrate_pair(pair: PlacedPair) -> Outcome[PairCalibration]:
    """Fit the light sheets of one pair. Raises PairFailed if its stripes do not give any."""
    quality = PairQuality(pair.rms_px, pair.views, lenses=pair.lenses)
    camera, projector = pair.camera, pair.projector
    if projector is None:
        return Outcome(
            PairCalibration(
                pair.name, camera, pair.camera_covariance, None, quality, rays=pair.rays
            ),
        )
    notes: tuple[str, ...] = ()
    shots = pair.shots
    points = boundaries_on_boards(pair.name, camera, projector, shots)
    disagreement = find_projector_motion(points, projector.stripes, projector.direction)
    if disagreement is not None:
        agreed = drop_disagreeing(pair.name, shots, disagreement)
        shots, notes = agreed.value, agreed.notes
        points = boundaries_on_boards(pair.name, camera, projector, shots)
    fit = fit_light_sheets(points, projector.stripes, projector.direction)
    quality = replace(
        quality,
        planes_rms_mm=fit.rms_mm,
        stripe_shots=len(shots),
        stripes_calibrated=fit.stripes_calibrated,
        stripes_projected=projector.stripes - 1,
        held_out=fit.held_out,
        boards_mm=_mean_and_rms(board_offsets(points, fit.sheets)),
    )
    found = PairCalibration(
        pair.name, camera, pair.camera_covariance, fit.sheets, quality, rays=pair.rays
    )
    if pair.alone:
        # In a rig of several pairs all cameras together fix the boards, far better than the stripes
        # of one pair could.
        found, shots = _refined(found, pair.own, shots, points)
    crossed = _with_crossing(found, projector, shots)
    return Outcome(crossed.value, (*notes, *crossed.notes))


def _with_crossing(
    pair: PairCalibration, projector: StripeCode, shots: Sequence[StripedView]
) -> Outcome[PairCalibration]:
    """The pair with sheets of its crossing stripes, if any were projected.

    If they give no sheets the pair does without, and a note says so.
    """
    across = projector.crossing
    if across is None:
        return Outcome(pair)
    crossed = [
        replace(shot, boundaries=shot.boundaries.crossing)
        for shot in shots
        if shot.boundaries.crossing is not None
    ]
    try:
        points = boundaries_on_boards(pair.name, pair.camera, across, crossed)
        fit = fit_light_sheets(points, across.stripes, across.direction)
    except PairFailed as error:
        return Outcome(pair, (f"{pair.name}: crossing stripes are not used: {error.what}",))
    said = f"{pair.name}: crossing stripes: {fit.model}, {fit.rms_mm:.3f} mm from their sheets"
    return Outcome(replace(pair, crossing=fit.sheets), (said,))


def drop_disagreeing(
    name: str, shots: Sequence[StripedView], found: ProjectorMotion
) -> Outcome[tuple[StripedView, ...]]:
    """The shots without those that do not fit. Raises PairFailed if the projector moved."""
    names = [shot.view.shot for shot in shots]
    misfit = f"{found.together_px:.1f} px off together, {found.apart_px:.1f} px apart"
    if found.moved:
        before, after = names[found.kept[-1]], names[found.others[0]]
        raise PairFailed(
            f"the projector moved between shots {before} and {after} (stripes are {misfit}), or the "
            f"images of {', '.join(names[k] for k in found.others)} are mixed up",
            where=f"pair {name}",
            remedy="fasten it and capture the boards again, or delete the shots before it moved",
        )
    odd = ", ".join(names[k] for k in found.others)
    said = f"the stripes of shot{'s' if len(found.others) > 1 else ''} {odd} do not fit the others'"
    note = (
        f"{name}: {said} ({misfit}): the board or the projector moved meanwhile, or images of several "
        "shots are mixed up; these stripes are not used"
    )
    kept = tuple(shot for k, shot in enumerate(shots) if k not in found.others)
    return Outcome(kept, (note,))


def _refined(
    pair: PairCalibration,
    own: CameraCalibration,
    shots: Sequence[StripedView],
    points: BoundaryPoints,
) -> tuple[PairCalibration, tuple[StripedView, ...]]:
    """Solve for camera, boards and light of a pair by itself together, if held-out boards gain.

    Also returns its shots, with the boards' poses from that solve.
    """
    assert pair.sheets is not None
    data = subsample(points, REFINED_BINS)
    boards = [
        striped_board(
            PlanarView(shot.view.shot, shot.view.points, shot.view.pixels),
            pair.camera,
            data,
            k,
            shot.view.board,
        )
        for k, shot in enumerate(shots)
    ]
    flatness = {shot.view.board: shot.board.believed_flatness_mm for shot in shots}
    choice = refine_where_better(own, pair.sheets, boards, data, flatness)
    quality = replace(
        pair.quality,
        refinement=choice.reason,
        flatness_mm=choice.flatness_mm,
        ways=choice.trials,
    )
    fit = choice.fit
    if fit is None:
        return replace(pair, quality=quality), tuple(shots)
    bent = {name: form.out_of_plane_mm for name, form in fit.forms.items() if form.heights.any()}
    refined = replace(
        pair,
        camera=fit.camera,
        camera_covariance=fit.camera_covariance,
        sheets=fit.sheets,
        quality=replace(quality, bent_mm=bent),
    )
    if not choice.taken:
        return refined, tuple(shots)
    poses = fit.camera_from_board
    placed = (
        replace(shot, view=replace(shot.view, camera_from_board=poses[shot.view.shot]))
        for shot in shots
    )
    quality = replace(refined.quality, corners_rms_px=fit.corners_rms_px)
    return replace(refined, quality=quality), tuple(placed)


def _mean_and_rms(values: Array) -> tuple[float, float] | None:
    return (float(values.mean()), float(np.sqrt((values**2).mean()))) if values.size else None
