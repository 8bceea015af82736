"""Check a calibrated rig, by shots of a board or by scans of people; repair or refine it."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from bodyscan.alignment.displaced_poles import (
    MIN_DRIFT_MM,
    MIN_SCANS,
    DisplacementSearch,
    PairDrift,
    compute_motions_between,
    estimate_drift,
    find_displaced_pole,
)
from bodyscan.alignment.icp import Alignment, align
from bodyscan.alignment.sway_prior import BODY_CENTRE
from bodyscan.arrays import Array
from bodyscan.boards.view import BoardView
from bodyscan.calibration.board_views import LocatedView
from bodyscan.calibration.boundary_points import BoardBoundaries, StripedView, on_board
from bodyscan.calibration.camera import CameraCalibration
from bodyscan.calibration.pair import PairCalibration
from bodyscan.captures.folder import Captures, join_captures, open_check
from bodyscan.errors import BadInput, BoardNotFound, FailedWork
from bodyscan.fusion.cleaning import clean, require_subject
from bodyscan.geometry.light_sheets import intersect_rays
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.motion.object_refinement import refine_on_object
from bodyscan.outcome import Outcome
from bodyscan.progress import Progress, silent, step
from bodyscan.registration.drift import Drift, Move, find_drift, observe_pose
from bodyscan.registration.rig_calibration import RigCalibration
from bodyscan.rig.rig import find_connected_groups
from bodyscan.settings import AlignmentSettings
from bodyscan.workflows.decode import decode_on_boards
from bodyscan.workflows.find_boards import find_all_boards, locate_views
from bodyscan.workflows.range_images import reconstruct_range_images


def check_rig(
    calibration: RigCalibration,
    folders: Sequence[Path],
    progress: Progress = silent,
    *,
    follow_links: bool = False,
) -> BoardCheck | ScanCheck:
    """Check a rig with folders of one kind: shots of the board, or scans of people.

    Raises CaptureError for folders without captures, BadInput for a mixture of kinds,
    BoardNotFound, and ScanFailed if nobody is in a scan.
    """
    if follow_links:
        described = calibration.rig.model_copy(update={"follow_links": True})
        calibration = replace(calibration, rig=described)
    opened = [open_check(calibration.rig, folder) for folder in folders]
    kinds, captures = {kind for kind, _ in opened}, [found for _, found in opened]
    if len(kinds) > 1:
        raise BadInput(
            "shots of boards and scans of people cannot be checked together",
            where=", ".join(map(str, folders)),
            remedy="check one kind at a time",
        )
    if kinds == {"scan"}:
        return check_scans(calibration, captures, progress)
    return check_boards(calibration, join_captures(tuple(number_shots(captures))), progress)


def number_shots(folders: Sequence[Captures]) -> list[Captures]:
    """Put the folder's number before the name of each shot, if there are several folders."""
    if len(folders) == 1:
        return list(folders)
    return [
        replace(
            captures,
            shots=tuple(f"{number}/{shot}" for shot in captures.shots),
            sequences=tuple(replace(s, shot=f"{number}/{s.shot}") for s in captures.sequences),
        )
        for number, captures in enumerate(folders, start=1)
    ]


@dataclass(frozen=True)
class StripeOffset:
    """Distance of the surface that a pair's stripes measure from the board that its corners show."""

    pair: str
    offset_mm: float  # median over all boards, positive away from the camera
    tilt_mm: float  # half the difference between the board's two ends
    sigma_mm: float  # the sigma that the calibration predicts
    imported: str  # the file of another program that the pair's calibration is from, if any

    @staticmethod
    def from_distances(pair: PairCalibration, rows: Array) -> StripeOffset:
        """The medians of rows (N, 3) as `_measure_stripe_distances` returns them."""
        away, across, sigma = rows.T
        low, high = across < -0.4, across > 0.4
        tilt = 0.0
        if min(low.sum(), high.sum()) > 20:
            tilt = 0.5 * float(np.median(away[high]) - np.median(away[low]))
        away_mm, sigma_mm = float(np.median(away)), float(np.median(sigma))
        return StripeOffset(pair.name, away_mm, tilt, sigma_mm, pair.quality.imported)

    @property
    def moved(self) -> bool:
        """Whether the projector has moved relative to its camera: 5 sigmas and 0.25 mm."""
        return max(abs(self.offset_mm), abs(self.tilt_mm)) > max(5.0 * self.sigma_mm, 0.25)


@dataclass(frozen=True, eq=False)
class BoardCheck:
    """The drift of cameras and the stripe offsets of projectors, from shots of a board.

    checked, unchecked: calibrated pairs that saw a board, and that did not.
    """

    drift: Drift
    stripes: tuple[StripeOffset, ...]
    checked: tuple[str, ...]
    unchecked: tuple[str, ...]
    notes: tuple[str, ...]

    @property
    def valid(self) -> bool:
        return not self.drift.moves and not any(offset.moved for offset in self.stripes)

    @property
    def lines(self) -> tuple[str, ...]:
        """The check in words; the first line is the verdict."""
        drift = self.drift
        shared = bool(drift.rig_from_board)
        agreed = "all that see the board agree" if shared else "the stripes lie on the board"
        wrong = "the stripes do not lie on the board"
        if drift.moves:
            wrong = "something moved; --repair writes a corrected calibration"
        lines = [f"valid: {agreed}" if self.valid else f"NOT valid: {wrong}"]
        lines += [move_line(move) for move in drift.moves]
        for offset in filter(lambda offset: offset.moved, self.stripes):
            other = f", or {offset.imported} is not its calibration" if offset.imported else ""
            lines.append(
                f"{offset.pair}: the stripes measure the board {offset.offset_mm:+z.2f} mm from its "
                f"corners, tilted by {offset.tilt_mm:+z.2f} mm at its ends. Possible causes: the "
                f"projector moved against its camera{other}"
            )
        if shared:
            after = f", {drift.misfit:.1f} after the moves" if drift.moves else ""
            lines.append(
                f"{len(self.checked)} pairs saw a board; their views differ by "
                f"{drift.misfit_before:.1f} sigmas RMS{after}"
            )
        if self.stripes:
            worst = max(self.stripes, key=lambda offset: abs(offset.offset_mm))
            lines.append(
                f"stripes of {len(self.stripes)} pairs lie within {abs(worst.offset_mm):.2f} mm of the "
                f"board (worst: {worst.pair})"
            )
        if self.unchecked:
            lines.append(f"not checked, because they saw no board: {', '.join(self.unchecked)}")
        if drift.lonely:
            lonely = ", ".join(drift.lonely)
            lines.append(f"not checked, because no other pair saw their board: {lonely}")
        return (*lines, *(f"note: {note}" for note in self.notes))

    def repair(self, calibration: RigCalibration) -> RigCalibration:
        """Correct the poses of what moved. Raises FailedWork if that is nothing, or a projector."""
        projectors = [offset.pair for offset in self.stripes if offset.moved]
        if projectors:
            raise FailedWork(
                f"the projector of {', '.join(projectors)} moved against its camera",
                remedy="capture the stripes on the board again and run calibrate-rig: only a new "
                "calibration of that pair corrects this",
            )
        if not self.drift.moves:
            raise FailedWork("nothing moved: there is nothing to repair")
        return apply_moves(calibration, self.drift.moves)


def check_boards(
    calibration: RigCalibration, captures: Captures, progress: Progress = silent
) -> BoardCheck:
    """Compare the calibrated rig with one or more shots of the calibration's boards.

    A board seen by a single pair still shows whether that pair's stripes lie where its corners are.
    Raises BoardNotFound if no board is seen by two pairs and none has decoded stripes on it.
    """
    views = find_all_boards(calibration.rig, captures, progress)
    cameras = {name: _make_camera_calibration(pair) for name, pair in calibration.pairs.items()}
    located = locate_views(calibration.rig, views.value, cameras)
    unique = [view for view in located.value if not view.ambiguous]
    # Sigma of one coordinate of a corner.
    noise_px = {name: max(one.rms_px / np.sqrt(2.0), 0.02) for name, one in cameras.items()}
    poses = [observe_pose(v, cameras[v.pair].camera, noise_px[v.pair]) for v in unique]
    drift = find_drift(
        poses, calibration.rig_from_camera, calibration.covariance, calibration.rig.poles
    )
    # Which end of a plain board is which makes no difference to its surface.
    stripes = _measure_stripe_offsets(calibration, captures, views.value, located.value, progress)
    notes = (*views.notes, *located.notes, *stripes.notes)
    if not drift.rig_from_board and not stripes.value:
        raise _make_no_board_error(captures, notes)
    checked = tuple(sorted({view.pair for view in (unique or located.value)}))
    unchecked = tuple(sorted(set(calibration.pairs) - set(checked)))
    return BoardCheck(drift, stripes.value, checked, unchecked, notes)


def _make_no_board_error(captures: Captures, notes: Sequence[str]) -> BoardNotFound:
    why = "".join(f"\n  {note}" for note in dict.fromkeys(notes))
    return BoardNotFound(
        "no board is seen by two calibrated pairs at once (one that looks the same when turned by 180 "
        f"degrees does not count), and no stripes on one were decoded{why}",
        where=", ".join(str(folder) for folder in captures.folders),
        remedy="show a board whose corners are numbered (ChArUco) to as many cameras as can see "
        "it together, or take the stripe sequence on a board",
    )


def apply_moves(calibration: RigCalibration, moves: Sequence[Move]) -> RigCalibration:
    """Set the moved pairs to their new poses, and leave everything else unchanged.

    A pole takes along those of its pairs that saw no board. The covariance of a move is added to that
    of its pairs, which share its error.
    """
    poses, covariance = dict(calibration.rig_from_camera), calibration.covariance
    poles = calibration.rig.poles
    for move in moves:
        carried = {poles[pair] for pair in move.pairs if len(move.pairs) > 1}
        pairs = [pair for pair in poses if pair in move.pairs or poles.get(pair) in carried]
        poses |= {pair: move.motion @ poses[pair] for pair in pairs}
        covariance = covariance.add_motions(pairs, move.covariance, common=True)
    notes = tuple(f"repaired: {move_line(move)}" for move in moves)
    notes = (*calibration.notes, *notes)
    return replace(calibration, rig_from_camera=poses, covariance=covariance, notes=notes)


def move_line(move: Move) -> str:
    """State how far a pair or pole moved."""
    return (
        f"{move.name} moved by {move.shift_mm:.2f} mm (sigma {move.sigma_mm:.2f}) and "
        f"{move.turn_deg:.3f} degrees"
    )


def _make_camera_calibration(pair: PairCalibration) -> CameraCalibration:
    """Describe a pair's camera; if its corner errors are unknown, 0.5 px, typical of OpenCV."""
    known, imported = pair.quality.corners_rms_px, pair.quality.imported_sigma_px
    rms_px = known if known is not None else imported or 0.5
    return CameraCalibration(pair.camera, pair.camera_covariance, (), rms_px)


def _measure_stripe_offsets(
    calibration: RigCalibration,
    captures: Captures,
    views: Sequence[BoardView],
    located: Sequence[LocatedView],
    progress: Progress,
) -> Outcome[tuple[StripeOffset, ...]]:
    """Stripe offsets of every pair that took stripes on a board it saw."""
    known = {view.key: view for view in located if calibration.pairs[view.pair].sheets is not None}
    wanted = [view for view in views if view.key in known]
    decoded = decode_on_boards(calibration.rig, captures, wanted, progress)
    parts: dict[str, list[Array]] = defaultdict(list)
    for key, boundaries in decoded.value.items():
        parts[key[0]].append(_measure_stripe_distances(calibration, known[key], boundaries))
    rows = {pair: np.concatenate(found) for pair, found in sorted(parts.items())}
    offsets = tuple(
        StripeOffset.from_distances(calibration.pairs[pair], found)
        for pair, found in rows.items()
        if len(found) >= 100
    )
    lost = (f"{pair}: {reason}" for pair, reason in decoded.failures.items())
    return Outcome(offsets, (*decoded.notes, *lost))


def _measure_stripe_distances(
    calibration: RigCalibration, view: LocatedView, boundaries: BoardBoundaries
) -> Array:
    """Distances of a view's stripe boundaries from the board: (N, 3), distance along its normal (mm),
    position across the stripes (-1 to 1), sigma (mm)."""
    rig, pair = calibration.rig, calibration.pairs[view.pair]
    projector = rig.pair(view.pair).projector
    assert projector is not None
    assert pair.sheets is not None
    shot = StripedView(view, rig.board(view.board), boundaries)
    points = on_board(
        pair.camera, projector, shot.board, shot.camera_from_face, boundaries, number=0
    )
    rays = points.points / points.points[:, 2:]
    measured = intersect_rays(pair.sheets, rays, points.index.astype(float))
    facing = np.abs(rays @ view.camera_from_board.rotation[:, 2])
    away = (measured.depth - points.points[:, 2]) * facing
    axis = 1 if projector.direction == "horizontal" else 0
    across = points.points[:, axis] - np.mean(points.points[:, axis])
    across = across / max(float(np.abs(across).max(initial=0.0)), 1e-9)
    rows = np.stack([away, across, np.sqrt(measured.variance_mm2) * facing], axis=1)
    return rows[np.all(np.isfinite(rows), axis=1)]


@dataclass(frozen=True, eq=False)
class ScanCheck:
    """What scans of people tell about a rig.

    before_mm, after_mm: of each scan, RMS distance of its overlaps before and after alignment.
    pairs: the mean motion of each pair by alignment.
    search: the search for single moves, given the time at which each pair saw the person.
    groups: groups of pairs that no overlap of any scan connects, the largest first; empty if there
        is only one group. How groups stand relative to each other is not observed: pairs that moved
        far enough share nothing.
    """

    before_mm: tuple[float, ...]
    after_mm: tuple[float, ...]
    pairs: tuple[PairDrift, ...]
    search: DisplacementSearch
    groups: tuple[tuple[str, ...], ...] = ()

    @property
    def detectable_mm(self) -> float:
        """The largest move of a pair or pole, mm, that could pass for a person's motion."""
        return min(max(drift.limit_mm for drift in self.pairs), self.search.detectable_mm)

    @property
    def decided(self) -> bool:
        """Whether a harmful move can be distinguished from sway, and all pairs are connected.

        Alignment corrects a pole that moved by less than 5 mm: girths are still good to 2 mm.
        """
        return self.detectable_mm <= 5.0 and not self.groups

    @property
    def quiet(self) -> bool:
        """Whether there is nothing to explain, neither sway nor a move."""
        still = all(drift.shift_mm < MIN_DRIFT_MM for drift in self.pairs)
        return still and max(self.before_mm) < 0.5 and not self.groups

    @property
    def moved(self) -> bool:
        return any(drift.moved for drift in self.pairs) or self.search.found is not None

    @property
    def valid(self) -> bool:
        return not self.moved and (self.decided or self.quiet)

    @property
    def lines(self) -> tuple[str, ...]:
        """The check in words; the first line is the verdict."""
        step = self.search.found
        count = len(self.before_mm)
        scans = "1 scan" if count == 1 else f"{count} scans"
        if self.moved:
            verdict = "NOT valid: no motion of a person explains how the pairs differ"
        elif self.groups:
            groups = "; ".join(", ".join(group) for group in self.groups)
            verdict = (
                f"undecided: no surface is seen by more than one of these groups of pairs: {groups}. "
                "Scans do not determine how these stand to each other: give shots of a board that they "
                "share"
            )
        elif self.decided:
            verdict = (
                f"valid: a pole or pair that moved by {self.detectable_mm:.1f} mm would be noticed"
            )
        elif self.quiet:
            verdict = "valid: all pairs see the same surface, and alignment moves none of them"
        else:
            known = np.isfinite(self.detectable_mm)
            less = f" by less than {self.detectable_mm:.1f} mm" if known else ""
            more = f"{MIN_SCANS} scans or more" if count < MIN_SCANS else "more scans"
            verdict = (
                f"undecided: in {scans}, a pair that moved{less} cannot be distinguished from a "
                f"person's sway; give {more}, or a shot of the board (with `kind: calibration` in its "
                "captures.yaml)"
            )
        lines = [verdict]
        if step is not None:
            lines.append(
                f"{step.name} is displaced by {step.shift_mm:.1f} mm and rotated by "
                f"{step.rotation_deg:.2f} degrees"
            )
        for drift in self.pairs:
            if drift.moved and (step is None or drift.pair not in step.name):
                lines.append(f"{drift.pair}: {drift.shift_mm:.2f} mm (sigma {drift.sigma_mm:.2f})")
        before, after = max(self.before_mm), max(self.after_mm)
        if np.isfinite(before):
            lines.append(f"overlaps in {scans}: {before:.2f} mm RMS at most, {after:.2f} aligned")
        farthest = max(self.pairs, key=lambda drift: drift.shift_mm)
        lines.append(f"moved most on average: {farthest.pair}, {farthest.shift_mm:.2f} mm")
        return tuple(lines)

    def repair(self, calibration: RigCalibration) -> RigCalibration:
        """Always raises FailedWork: scans alone do not determine the poses well enough."""
        raise FailedWork(
            "scans of people show that something moved, but not exactly where it is now",
            remedy="take a few shots of the board and repair from those",
        )


def check_scans(
    calibration: RigCalibration, scans: Sequence[Captures], progress: Progress = silent
) -> ScanCheck:
    """Align these scans of people and judge the rig. Raises ScanFailed if one shows nobody."""
    alignments, moments = [], []
    for captures in scans:
        images = reconstruct_range_images(calibration, captures, progress).value
        cleaned = clean(images, calibration.rig_from_camera, calibration.rig.volume)
        kept = require_subject(cleaned)
        alignments.append(
            align(kept, calibration.rig_from_camera, calibration.covariance, AlignmentSettings())
        )
        moments.append({image.pair: image.time_ms for image in kept})
    return judge_scans(alignments, calibration.rig_from_camera, calibration.rig.poles, moments)


def judge_scans(
    alignments: Sequence[Alignment],
    rig_from_camera: Mapping[str, RigidTransform],
    poles: Mapping[str, str],
    moments_ms: Sequence[Mapping[str, float | None]],
) -> ScanCheck:
    """Judge a rig by the alignments of its scans.

    rig_from_camera: the calibrated poses.
    poles: the pole of each pair that stands on one.
    moments_ms: of each scan, the time at which each pair saw the person; None if not known.
    """
    shifts: dict[str, list[Array]] = defaultdict(list)
    for found in alignments:
        for name, pose in found.rig_from_camera.items():
            change = pose @ rig_from_camera[name].inverse()
            shifts[name].append(change.apply(BODY_CENTRE) - BODY_CENTRE)
    motions = [
        compute_motions_between(
            rig_from_camera, {n: found.rig_from_camera[n] for n in found.motion_mm}
        )
        for found in alignments
    ]
    return ScanCheck(
        tuple(found.rms_before_mm for found in alignments),
        tuple(found.rms_after_mm for found in alignments),
        tuple(estimate_drift(name, np.array(each)) for name, each in sorted(shifts.items())),
        find_displaced_pole(list(zip(motions, moments_ms, strict=True)), poles),
        _separate_groups(alignments),
    )


def _separate_groups(alignments: Sequence[Alignment]) -> tuple[tuple[str, ...], ...]:
    """Connected components of the overlaps of all scans, the largest first; () if there is one."""
    names = [name for found in alignments for name in found.rig_from_camera]
    edges = [(one.source, one.target) for found in alignments for one in found.overlaps]
    groups = sorted((tuple(sorted(one)) for one in find_connected_groups(names, edges)), key=len)
    return tuple(groups[::-1]) if len(groups) > 1 else ()


def refine_rig(
    calibration: RigCalibration, captures: Captures, name: str, progress: Progress = silent
) -> Outcome[RigCalibration]:
    """Refine the poses of the pairs by ICP on a rigid object, within the covariance of the boards.

    captures: a scan of an object that stood still.
    name: what the calibration's notes call it.

    Raises FailedWork if overlaps come no closer or the object moved, ScanFailed without an object.
    """
    measured = reconstruct_range_images(calibration, captures, progress)
    with step(progress, "aligning"):
        cleaned = clean(measured.value, calibration.rig_from_camera, calibration.rig.volume)
        found = refine_on_object(
            require_subject(cleaned),
            calibration.rig_from_camera,
            calibration.covariance,
            calibration.rig.poles,
        )
    if not found.better:
        what = "the overlaps do not come closer, or hardly: the calibration stays as it is"
        raise FailedWork("\n  ".join([what, *found.lines]))
    notes = (*calibration.notes, *(f"refined on {name}: {line}" for line in found.lines))
    refined = replace(calibration, rig_from_camera=found.rig_from_camera, notes=notes)
    return Outcome(refined, tuple(found.lines), measured.failures)
