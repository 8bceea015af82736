"""Calibrate a rig: boards, cameras, board poses, joint solve, stripes on boards, light sheets."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from bodyscan.boards.view import BoardView, ViewKey
from bodyscan.calibration.board_views import LocatedView
from bodyscan.calibration.boundary_points import BoardBoundaries
from bodyscan.calibration.camera import CameraCalibration
from bodyscan.calibration.pair import PairCalibration, calibrate_pair
from bodyscan.captures.check import describe_unlisted_images
from bodyscan.captures.folder import Captures, open_captures
from bodyscan.errors import BadInput, BodyscanError, FailedWork, RigDisconnected, format_error
from bodyscan.optional import optional
from bodyscan.outcome import Outcome
from bodyscan.progress import Progress, attempt_each, silent, step
from bodyscan.registration.advice import advise
from bodyscan.registration.board_checks import correct_stretch, list_boards_not_found
from bodyscan.registration.references import find_rig_size, rescale_boards, select_solving_views
from bodyscan.registration.rig_calibration import RigCalibration, refuse_wrong_size
from bodyscan.registration.rig_frame import hold_frame, refuse_without_frame_shot
from bodyscan.registration.rig_solve import (
    RigSolution,
    collect_corners,
    make_solved_pair,
    solve_rig,
    update_poses,
)
from bodyscan.registration.sanity_checks import find_faults
from bodyscan.registration.storage import CORNERS_NAME, archive_previous, save_calibration
from bodyscan.rig.rig import Rig, load_rig
from bodyscan.workflows.decode import PrintAreas, decode_on_boards
from bodyscan.workflows.find_boards import (
    HERE,
    FoundBoards,
    calibrate_cameras,
    choose_frame,
    find_all_boards,
    locate_views,
    make_no_pair_error,
    require_cameras,
    write_found_corners,
)


def calibrate_rig(
    rig: Rig, captures: Captures, progress: Progress = silent, *, folder: Path = HERE
) -> RigCalibration:
    """Calibrate a rig from its board images, and add advice.

    folder: what the paths of `known` cameras are relative to.

    A bad image or pair costs only that image or pair, and is named in `failed` or `notes`. Raises
    FailedWork if no pair is left (of a rig with projectors: none that has one), RigDisconnected if
    nothing ties the pairs together, BadInput if nothing fixes the rig frame.
    """
    rig, boards = _find_boards(rig, captures, progress)
    return add_remarks(solve_boards(rig, captures, boards, progress, folder=folder), progress)


def _find_boards(rig: Rig, captures: Captures, progress: Progress) -> tuple[Rig, FoundBoards]:
    """The boards, and the rig with a frame that can be fixed: that is found out first, in seconds."""
    refuse_without_frame_shot(rig, captures.shots)
    framed = choose_frame(rig, captures)
    boards = find_all_boards(rig, captures, progress)
    return framed.value, replace(boards, notes=(*framed.notes, *boards.notes))


def calibrate_folder(
    rig_file: Path, folder: Path, progress: Progress = silent
) -> tuple[RigCalibration, Path]:
    """Calibrate a rig like `calibrate_rig` and save it; return it and the path of its JSON.

    It is saved last and whole: after an interruption `folder` holds what it held, and the same call
    completes it. A calibration already there moves into its history. Raises RigFileError and
    CaptureError as well.
    """
    rig = load_rig(rig_file)
    captures = open_captures(rig, rig_file)
    rig, boards = _find_boards(rig, captures, progress)
    solved = solve_boards(rig, captures, boards, progress, folder=Path(rig_file).parent)
    remarked = add_remarks(solved, progress)
    archive_previous(folder)
    notes = list(remarked.notes)
    with optional(CORNERS_NAME, notes.append):
        write_found_corners(folder / CORNERS_NAME, rig, captures, boards.value)
    with optional("images that are not used", notes.append):
        notes += filter(None, [describe_unlisted_images(captures)])
    calibration = replace(remarked, notes=tuple(notes))
    return calibration, save_calibration(calibration, folder)


def solve_boards(
    rig: Rig,
    captures: Captures,
    boards: FoundBoards,
    progress: Progress = silent,
    *,
    folder: Path = HERE,
) -> SolvedRig:
    """Calibrate a rig from boards found in its images, without the remarks on it."""
    cameras = calibrate_cameras(rig, boards.value, progress, folder=folder)
    cameras = require_cameras(rig, captures, boards, cameras)
    rig, stretched = correct_stretch(rig, boards.value, cameras.value)
    if stretched:
        cameras = calibrate_cameras(rig, boards.value, progress, folder=folder)
    located = locate_views(rig, select_solving_views(rig, boards.value), cameras.value)
    prints = PrintAreas(rig, cameras.value, {view.key: view for view in located.value})
    with step(progress, "joining the pairs"):
        solved = _bundle_adjust(rig, boards, located, cameras)
    views = [view for view in boards.value if view.key in prints.located]
    stripes = decode_on_boards(rig, captures, views, progress, prints=prints)
    pairs = _fit_light(solved, stripes, progress)
    solution = solved.solution.value
    stages = (boards, cameras, solved.located, stripes, pairs, solved.solution)
    failed = {name: reason for stage in stages for name, reason in stage.failures.items()}
    projecting = {pair.name for pair in rig.pairs if pair.projector}
    if not pairs.value or (projecting and not projecting & pairs.value.keys()):
        raise make_no_pair_error(rig, failed)
    for pair in pairs.value.values():
        solution = update_poses(solved.rig, solution, pair)
    notes = (*stretched, *solved.rig_notes, *(note for stage in stages for note in stage.notes))
    calibration = RigCalibration(
        solved.rig,
        pairs.value,
        {name: solution.rig_from_camera[name] for name in pairs.value},
        solution.covariance,
        solution.rig_from_board,
        {name: captures.relative(reason) for name, reason in failed.items()},
        tuple(captures.relative(note) for note in notes),
        observed=collect_corners(solution, pairs.value),
    )
    for where, what in find_faults(calibration):
        raise FailedWork(
            f"the joint solve gives an impossible rig: {where} {what}",
            where=f"rig {rig.name}",
            remedy="Possible causes: corners are mixed up in some views, or shots of different "
            "moments are listed as one. Leave out the shots in doubt",
        )
    return SolvedRig(calibration, solution, boards.value, boards.count_searched(captures))


@dataclass(frozen=True, eq=False)
class _Adjusted:
    """The joint solve and what led to it."""

    # With board sizes corrected by reference lengths, and a frame held by a pair that is there.
    rig: Rig
    rig_notes: tuple[str, ...]  # on these
    located: Outcome[list[LocatedView]]  # each view's board pose by itself
    solution: Outcome[RigSolution]


def _bundle_adjust(
    rig: Rig,
    boards: FoundBoards,
    located: Outcome[list[LocatedView]],
    cameras: Outcome[dict[str, CameraCalibration]],
) -> _Adjusted:
    """Solve for all poses and cameras; if reference lengths correct the size, solve again."""
    try:
        solution = _solve_rig(rig, located.value, cameras)
    except RigDisconnected as error:  # a board in flipped images moves as no other camera sees it
        mirrored = (note for note in boards.notes if " is mirrored in " in note)
        remedy = "\n  ".join([*mirrored, error.remedy])
        raise RigDisconnected(error.what, where=error.where, remedy=remedy) from error
    size = find_rig_size(rig, solution.value, boards.value)
    if size.value.factor != 1.0:
        rig = rescale_boards(rig, size.value.factor)
        located = locate_views(rig, select_solving_views(rig, boards.value), cameras.value)
        solution = _solve_rig(rig, located.value, cameras)
    framed = hold_frame(rig, solution.value.views, solution.value.rig_from_camera)
    refuse_wrong_size(rig, solution.value.rig_from_camera)
    notes = list(size.notes)
    if framed is not rig:
        notes.append(
            f"pair {rig.pairs[0].name}, the first in the rig file, could not be calibrated: the rig "
            f"frame is held by pair {framed.rig_frame.pair} (name a pair in `rig_frame` to choose one)"
        )
    return _Adjusted(framed, tuple(notes), located, solution)


def _solve_rig(
    rig: Rig, views: list[LocatedView], cameras: Outcome[dict[str, CameraCalibration]]
) -> Outcome[RigSolution]:
    try:
        return solve_rig(rig, views, {name: one.camera for name, one in cameras.value.items()})
    except BadInput as error:
        # The board or pair that fixes the frame may be missing because a pair failed earlier.
        before = "; ".join(f"{name}: {reason}" for name, reason in cameras.failures.items())
        remedy = f"{error.remedy}\n  left out before: {before}" if before else error.remedy
        raise BadInput(error.what, where=error.where, remedy=remedy) from error


def _fit_light(
    solved: _Adjusted, stripes: Outcome[dict[ViewKey, BoardBoundaries]], progress: Progress
) -> Outcome[dict[str, PairCalibration]]:
    """Fit the light sheets of each pair whose stripes were decoded, or that has no projector."""
    solution = solved.solution.value

    def fit(name: str) -> Outcome[PairCalibration]:
        boundaries = {key: near for key, near in stripes.value.items() if key[0] == name}
        return calibrate_pair(make_solved_pair(solved.rig, solution, name, boundaries))

    # One after another: fits are many small steps, and two at once hand the interpreter's lock to
    # and fro 70,000 times a second, which costs more than it gains (12 pairs: 26 s instead of 19).
    pairs, errors = attempt_each(
        fit,
        sorted(solution.rig_from_camera.keys() - stripes.failures.keys()),
        BodyscanError,
        stage="fitting light sheets",
        progress=progress,
        workers=1,
    )
    return Outcome(
        {name: pair.value for name, pair in pairs.items()},
        tuple(note for pair in pairs.values() for note in pair.notes),
        {name: format_error(error) for name, error in errors.items()},
    )


@dataclass(frozen=True, eq=False)
class SolvedRig:
    """A calibration and what the remarks on it are made from."""

    calibration: RigCalibration
    solution: RigSolution  # the joint solve, including pairs that failed later
    views: Sequence[BoardView]  # all boards that were found
    images: int  # number of images in which boards were looked for


def add_remarks(solved: SolvedRig, progress: Progress = silent) -> RigCalibration:
    """Add notes on the boards, and advice, to a calibration.

    None of these is essential: a remark that fails is replaced by a note.
    """
    found = solved.calibration
    notes: list[str] = list(found.notes)
    advice: list[str] = []
    with optional("boards that were not found", notes.append):
        notes += list_boards_not_found(found.rig, solved.views, solved.images)
    if len(solved.solution.rig_from_camera) > 1 and not found.failed:
        with step(progress, "advice"), optional("advice", notes.append):
            advice += advise(found.rig, solved.solution)
    with optional("boards by the stripes", notes.append):
        advice += note_stripe_boards(found.pairs)
    return replace(found, notes=tuple(notes), advice=tuple(advice))


def note_stripe_boards(pairs: Mapping[str, PairCalibration]) -> Iterator[str]:
    """Say how far the boards as measured by the stripes lie from their corners."""
    boards = {n: p.quality.boards_mm for n, p in pairs.items() if p.quality.boards_mm is not None}
    if boards:
        worst = max(sorted(boards), key=lambda name: boards[name][1])
        mean = sum(mean for mean, _ in boards.values()) / len(boards)
        rms = (sum(rms**2 for _, rms in boards.values()) / len(boards)) ** 0.5
        yield (
            f"boards measured by stripes against by corners: mean {mean:+z.3f}, RMS {rms:.3f} mm; "
            f"worst pair {worst}, {boards[worst][1]:.3f} mm RMS"
        )
