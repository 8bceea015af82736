"""Calibrate one pair from boards of known pose: check its stripes, fit its light sheets."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from bodyscan.arrays import Array, Indices
from bodyscan.calibration.board_views import LocatedView, PlanarView
from bodyscan.calibration.boundary_points import (
    BoundaryPoints,
    StripedView,
    locate_boundaries_on_boards,
    select,
    subsample,
)
from bodyscan.calibration.camera import LensTrial
from bodyscan.calibration.joint_refinement import BoardStripes, StripedBoard, refine_jointly
from bodyscan.calibration.light_sheets import fit_light_sheets
from bodyscan.calibration.model_selection import HeldOutModel
from bodyscan.calibration.sheet_fit import fit_pinhole, fit_sheets
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
    """A calibrated pair, camera frame.

    camera_covariance: covariance of the camera's parameters, (P, P).
    sheets: None for a camera without a projector.
    crossing: sheets of the crossing stripes, None if there are none or they are not known.
    """

    name: str
    camera: Camera
    camera_covariance: Array
    sheets: LightSheets | None
    quality: PairQuality
    crossing: LightSheets | None = None
    rays: RayUncertainty | None = None


@dataclass(frozen=True, eq=False)
class LocatedPair:
    """A pair whose camera and boards are known: the input for fitting its light sheets.

    camera, camera_covariance: the camera after the joint solve of the rig's corners, and the
        covariance (P, P) of its parameters.
    rays: how well each pixel's ray is known.
    views: every board view that the camera contributed, with `camera_from_board` from that solve.
    shots: those with decoded stripes.
    alone: whether no other pair constrains the boards.
    """

    name: str
    camera: Camera
    camera_covariance: Array
    rays: RayUncertainty | None
    lenses: tuple[LensTrial, ...]
    rms_px: float
    projector: StripeCode | None
    views: tuple[LocatedView, ...]
    shots: tuple[StripedView, ...]
    boards: tuple[Board, ...]
    alone: bool


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
    consistent = drop_inconsistent(pair.name, pair.camera, code, pair.shots)
    shots, notes = consistent.value, consistent.notes
    points = locate_boundaries_on_boards(pair.name, pair.camera, code, shots)
    fit = fit_light_sheets(points, code.stripes, code.direction)
    offsets = board_offsets(points, fit.sheets)
    quality = replace(
        calibration.quality,
        planes_rms_mm=fit.rms_mm,
        stripe_shots=len(shots),
        stripes_calibrated=fit.stripes_calibrated,
        stripes_projected=code.stripes - 1,
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


def drop_inconsistent(
    name: str, camera: Camera, code: StripeCode, shots: Sequence[StripedView]
) -> Outcome[tuple[StripedView, ...]]:
    """Drop shots whose stripes lie where the light of the others cannot put them.

    Raises PairFailed if the projector moved between two shots.
    """
    points = locate_boundaries_on_boards(name, camera, code, shots)
    split = find_projector_motion(points, code.stripes, code.direction)
    if split is None:
        return Outcome(tuple(shots))
    names = [shot.view.shot for shot in shots]
    misfit = f"{split.joint_px:.1f} px RMS as one group, {split.separate_px:.1f} px as two"
    others = ", ".join(names[k] for k in split.others)
    if split.moved:
        raise PairFailed(
            f"the stripes changed between shots {names[split.kept[-1]]} and "
            f"{names[split.others[0]]} ({misfit}). Possible causes: the projector moved; the images "
            f"of {others} are mixed up",
            where=f"pair {name}",
            remedy="fasten it and capture the boards again, or delete the shots before it moved",
        )
    plural = "s" if len(split.others) > 1 else ""
    note = (
        f"{name}: the stripes of shot{plural} {others} do not fit the others' ({misfit}) and are not "
        "used. Possible causes: the board or the projector moved during the sequence; images of "
        "several shots are mixed up"
    )
    return Outcome(tuple(shot for k, shot in enumerate(shots) if k not in split.others), (note,))


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
        calibration,
        camera=joint.camera,
        camera_covariance=joint.camera_covariance,
        quality=quality,
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


MAX_MISFIT_PX = 0.4
"""Boards that agree this well are not examined further."""
MIN_GROUP = 3
"""Two boards agree on nearly any light."""


@dataclass(frozen=True, eq=False)
class ProjectorMotion:
    """A split of the boards into two groups, each of which is consistent with one light.

    kept, others: numbers of the boards in each group, in the order of the shots; `others` are a few
        that do not fit or, where the projector `moved`, all that were taken afterwards.
    joint_px, separate_px: RMS misfit of the stripes with one light for all boards, and with one for
        each group.
    """

    kept: Indices
    others: Indices
    joint_px: float
    separate_px: float
    moved: bool = False


def find_projector_motion(
    data: BoundaryPoints, stripes: int, direction: Axis
) -> ProjectorMotion | None:
    """Split the boards into groups with different light; None if all agree or there are fewer than
    three.

    data: its `board` counts in the order of the shots.

    Raises PairFailed if the misfit is larger than a stripe and no split explains it.
    """
    few = subsample(data, 1200)
    boards = np.unique(few.board)
    if len(boards) < 3:
        return None
    joint = _misfit(few, [boards], stripes, direction)
    if joint < MAX_MISFIT_PX:
        return None
    best, separate = None, joint
    for split in _candidate_splits(
        boards, joint, lambda groups: _misfit(few, groups, stripes, direction)
    ):
        if 3.0 * split.separate_px < separate:
            best, separate = split, split.separate_px
        if separate < MAX_MISFIT_PX:
            break
    if best is None and joint > (width := _stripe_width(few)):
        raise PairFailed(
            f"no projector explains the stripes on {len(boards)} boards, nor those on most of them: "
            f"the misfit is {joint:.1f} px, a stripe is {width:.1f} px wide. Possible causes: images "
            "of several shots are mixed up; `stripes` or `direction` is wrong",
            remedy="check that the lit image and the patterns of each shot belong together, and "
            "`stripes` and `direction` in the rig file",
        )
    return best


def board_offsets(data: BoundaryPoints, sheets: LightSheets) -> Array:
    """Compute the offset (B,) mm of each board as the stripes measure it from its pose by corners.

    Median along the board's normal, positive away from the camera.
    """
    rays = data.points / data.points[:, 2:]
    depth = intersect_rays(sheets, rays, data.index.astype(float)).depth
    offset = (depth - data.points[:, 2]) * data.board_errors.facing
    known = np.isfinite(offset)
    offset, board = offset[known], data.board[known]
    return np.array([np.median(offset[board == k]) for k in np.unique(board)], np.float64)


Misfit = Callable[[Sequence[Indices]], float]


def _candidate_splits(boards: Indices, joint: float, misfit: Misfit) -> Iterator[ProjectorMotion]:
    """Yield possible splits, simplest first: without one board, in time, without several.

    Boards are dropped one after another, each time the one without which the others agree best, while
    most boards are left and their agreement still means something.
    """
    kept, min_kept = boards, max(MIN_GROUP, len(boards) // 2 + 1)
    while len(kept) > min_kept or kept is boards:
        separate, dropped = min((misfit([kept[kept != board]]), board) for board in kept)
        first = kept is boards
        kept = kept[kept != dropped]
        yield ProjectorMotion(kept, np.setdiff1d(boards, kept), joint, separate)
        if first and len(boards) > 3:
            yield _split_in_time(boards, joint, misfit)


def _split_in_time(boards: Indices, joint: float, misfit: Misfit) -> ProjectorMotion:
    """Split all boards before a shot from all after it, where the groups agree best.

    If only two boards come first, their agreement means nothing: they are dropped, and the others
    determine the projector.
    """
    cuts = range(2, len(boards) - 1)
    separate, first = min((misfit([boards[:cut], boards[cut:]]), cut) for cut in cuts)
    before, after = boards[:first], boards[first:]
    if first < MIN_GROUP <= len(after):
        return ProjectorMotion(after, before, joint, separate)
    return ProjectorMotion(before, after, joint, separate, moved=True)


def _stripe_width(data: BoundaryPoints) -> float:
    """Estimate the width of a stripe, px: distance of neighbouring boundaries, median over boards."""
    across = np.sum(data.points * data.per_pixel, axis=1) / np.sum(data.per_pixel**2, axis=1)
    index, boards = data.index.astype(float), (data.board == k for k in np.unique(data.board))
    slopes = [np.polyfit(index[rows], across[rows], 1)[0] for rows in boards]
    return float(np.median(np.abs(slopes)))


def _misfit(
    data: BoundaryPoints, groups: Sequence[Indices], stripes: int, direction: Axis
) -> float:
    """Compute the RMS over boards of the median distance (px) of stripes from their group's sheets.

    The sheets may bow, so that no kind of projector is mistaken for one that moved.
    """
    medians = []
    for group in groups:
        points = select(data, np.isin(data.board, group))
        pinhole, middle = (
            fit_pinhole(points.points, points.index.astype(float)),
            points.points.mean(0),
        )
        plain = LensSheets.from_matrix(pinhole, middle, stripes, direction)
        fit = fit_sheets(BowedSheets.from_pinhole(plain, 1), points, max_steps=12)
        distance = np.abs(fit.distances_mm) / np.linalg.norm(points.per_pixel, axis=1)
        medians += [float(np.median(distance[points.board == board])) for board in group]
    return float(np.sqrt(np.mean(np.square(medians))))
