"""Calibration of a rig, stage by stage: boards, cameras, joint solve, light sheets, advice."""

from __future__ import annotations

import re
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

from bodyscan.boards.view import BoardView, ViewKey
from bodyscan.calibration.board_views import LocatedView, PlanarView
from bodyscan.calibration.camera import CameraCalibration, locate_board
from bodyscan.calibration.pair import PairCalibration, PlacedPair, calibrate_pair
from bodyscan.calibration.striped_view import (
    BoardBoundaries,
    Box,
    StripedView,
    bands_apart,
    box_of_print,
    on_print,
)
from bodyscan.captures.folder import Captures, open_captures
from bodyscan.captures.unlisted_images import describe_unlisted_images
from bodyscan.errors import BadInput, BodyscanError, FailedWork, format_error, format_list
from bodyscan.optional import optional
from bodyscan.outcome import Outcome
from bodyscan.progress import Progress, attempt_each, silent, step
from bodyscan.registration.board_checks import describe_findings
from bodyscan.registration.nominal_size import check_nominal_size
from bodyscan.registration.references import find_size, resized, solving_views
from bodyscan.registration.rig_calibration import RigCalibration
from bodyscan.registration.rig_frame import frame_target, refuse_without_frame_shot
from bodyscan.registration.rig_solve import RigSolution, solve_rig
from bodyscan.registration.seen_corners import seen_corners
from bodyscan.registration.soundness import find_faults
from bodyscan.registration.storage import CORNERS_NAME, keep_former, save_calibration
from bodyscan.rig.rig import Rig
from bodyscan.rig.rig_file import load_rig
from bodyscan.workflows.decode import Through, decode_on_boards
from bodyscan.workflows.find_boards import (
    HERE,
    FoundBoards,
    calibrate_cameras,
    find_all_boards,
    locate_views,
    write_found_corners,
)
from bodyscan.workflows.rig_remarks import JoinedRig, remarked

COUNTED = re.compile(r"\d+ (?=markers of|of)")
MOST_SEEN = 3
"""Images without a board whose findings an error quotes."""


def calibrate_rig(
    rig: Rig, captures: Captures, progress: Progress = silent, *, folder: Path = HERE
) -> RigCalibration:
    """Calibrate a rig from its board images, and add advice.

    folder: what the paths of `known` cameras are relative to.

    A bad image or pair costs only that image or pair, and is named in `failed` or `notes`. Raises
    FailedWork if no pair is left, RigDisconnected if nothing ties the pairs together, BadInput if
    nothing fixes the rig frame.
    """
    refuse_without_frame_shot(rig, captures.shots)
    boards = find_all_boards(rig, captures, progress)
    return remarked(join_rig(rig, captures, boards, progress, folder=folder), progress)


def calibrate_folder(
    rig_file: Path, folder: Path, progress: Progress = silent
) -> tuple[RigCalibration, Path]:
    """Calibrate a rig like `calibrate_rig` and save it; return it and the path of its JSON.

    It is saved once as soon as it is solved and again with the remarks on it. A calibration already
    in `folder` moves into its history. Raises RigFileError and CaptureError as well.
    """
    rig = load_rig(rig_file)
    captures = open_captures(rig, rig_file)
    refuse_without_frame_shot(rig, captures.shots)
    boards = find_all_boards(rig, captures, progress)
    found = join_rig(rig, captures, boards, progress, folder=Path(rig_file).parent)
    keep_former(folder)
    save_calibration(found.calibration, folder)
    unsaid: list[str] = []
    with optional(CORNERS_NAME, unsaid.append):
        write_found_corners(folder / CORNERS_NAME, rig, captures, boards.value)
    with optional("images that are not used", unsaid.append):
        unsaid += filter(None, [describe_unlisted_images(captures)])
    calibration = remarked(found, progress)
    calibration = replace(calibration, notes=(*calibration.notes, *unsaid))
    return calibration, save_calibration(calibration, folder)


def join_rig(
    rig: Rig,
    captures: Captures,
    boards: FoundBoards,
    progress: Progress = silent,
    *,
    folder: Path = HERE,
) -> JoinedRig:
    """From boards found in images to the calibration, without its optional parts."""
    searched = len(captures.sequences) - len(boards.refused)
    cameras = _cameras(rig, captures, boards, searched, progress, folder)
    solved, decoded, fitted = _solve_and_fit(rig, captures, boards.value, cameras, progress)
    rig, placed = solved.rig, solved.joined.value
    failed = {
        **cameras.failures,
        **decoded.failures,
        **solved.joined.failures,
        **fitted.failures,
    }
    pairs = fitted.value
    if not pairs:
        raise _nothing_calibrated(rig, failed)
    for pair in pairs.values():
        placed = update_poses(rig, placed, pair)
    stages = (boards, cameras, solved.located, decoded, fitted, solved.joined)
    notes = [*solved.sized, *(note for stage in stages for note in stage.notes)]
    calibration = RigCalibration(
        rig,
        pairs,
        {name: placed.rig_from_camera[name] for name in pairs},
        placed.covariance,
        placed.rig_from_board,
        {name: captures.relative(reason) for name, reason in failed.items()},
        tuple(captures.relative(note) for note in notes),
        seen=seen_corners(placed, pairs),
    )
    for place, what in find_faults(calibration):
        raise FailedWork(
            f"the boards together give what no rig can be: {place} {what}",
            where=f"rig {rig.name}",
            remedy="are corners mixed up in some views, or shots of different moments listed as one? "
            "Leave out the shots in doubt",
        )
    return JoinedRig(calibration, placed, boards.value, searched)


def _cameras(
    rig: Rig,
    captures: Captures,
    boards: FoundBoards,
    searched: int,
    progress: Progress,
    folder: Path,
) -> Outcome[dict[str, CameraCalibration]]:
    """Calibrate each camera by itself. Raises FailedWork if none can be.

    searched: number of sequences in which boards were looked for.
    """
    cameras = calibrate_cameras(rig, boards.value, progress, folder=folder)
    failures = cameras.failures
    if searched and not boards.value:
        # More poses of a board that is not as described would not help.
        failures = {name: reason.partition("\n")[0] for name, reason in failures.items()}
    cameras = replace(cameras, failures=boards.blamed_on_images(failures, captures))
    if not cameras.value:
        raise _nothing_calibrated(rig, cameras.failures, _seen_instead(rig, boards, searched))
    return cameras


def _solve_and_fit(
    rig: Rig,
    captures: Captures,
    boards: list[BoardView],
    cameras: Outcome[dict[str, CameraCalibration]],
    progress: Progress,
) -> tuple[_Solved, Outcome[dict[ViewKey, BoardBoundaries]], Outcome[dict[str, PairCalibration]]]:
    """The joint solve, stripes on the boards, and light sheets of the pairs that were joined."""
    located = locate_views(rig, solving_views(rig, boards), cameras.value)
    # Reading images takes one core and not the interpreter's lock; the other solves, and fits pair
    # after pair. Fits are many small steps: two at once hand the lock to and fro 70,000 times a
    # second, which costs more than it gains (12 pairs: 26 s instead of 19).
    with ThreadPoolExecutor(1) as beside:
        solving = beside.submit(_solve, rig, boards, located, cameras)
        fits: dict[str, Future[Outcome[PairCalibration]]] = {}

        def fit(name: str, boundaries: Mapping[ViewKey, BoardBoundaries]) -> None:
            fits[name] = beside.submit(_fit_sheets, solving, cameras.value, name, boundaries)

        decoded = _decode(
            rig, captures, boards, cameras.value, solving, located.value, fit, progress
        )
        with step(progress, "joining the pairs"):
            solved = solving.result()
        joined = solved.joined.value.rig_from_camera
        for name in joined:
            if name not in fits:  # none of its images had to be decoded
                fit(name, decoded.value)
        fitted = _fitted(fits, sorted(set(joined) - set(decoded.failures)), progress)
    return solved, decoded, fitted


def _seen_instead(rig: Rig, boards: FoundBoards, searched: int) -> str:
    """What images without the described board show instead: one image for each kind of finding,
    whatever the number of markers counted."""
    shown: dict[str, str] = {}
    for note in boards.notes:
        _, found, what = note.partition("no board found:")
        if found:
            shown.setdefault(COUNTED.sub("", what), note)
    findings = describe_findings(rig, boards.value, searched)
    return "\n  ".join([*filter(None, [findings]), *list(shown.values())[:MOST_SEEN]])


def _nothing_calibrated(rig: Rig, failed: Mapping[str, str], remedy: str = "") -> FailedWork:
    return FailedWork(
        f"no pair could be calibrated:{format_list(failed)}", where=f"rig {rig.name}", remedy=remedy
    )


def _join_pairs(
    rig: Rig, views: list[LocatedView], cameras: Outcome[dict[str, CameraCalibration]]
) -> Outcome[RigSolution]:
    try:
        return solve_rig(rig, views, {name: own.camera for name, own in cameras.value.items()})
    except BadInput as error:
        # The board or pair that fixes the frame may be missing because a pair failed earlier.
        before = "; ".join(f"{name}: {reason}" for name, reason in cameras.failures.items())
        remedy = f"{error.remedy}\n  left out before: {before}" if before else error.remedy
        raise BadInput(error.what, where=error.where, remedy=remedy) from error


@dataclass(frozen=True, eq=False)
class _Solved:
    """The joint solve and what led to it.

    rig: with board sizes corrected by reference lengths.
    sized: notes on that correction.
    located: each view's board pose by itself.
    joined: the joint solve.
    """

    rig: Rig
    sized: tuple[str, ...]
    located: Outcome[list[LocatedView]]
    joined: Outcome[RigSolution]


def _solve(
    rig: Rig,
    boards: list[BoardView],
    located: Outcome[list[LocatedView]],
    cameras: Outcome[dict[str, CameraCalibration]],
) -> _Solved:
    joined = _join_pairs(rig, located.value, cameras)
    size = find_size(rig, joined.value, boards)
    if size.value.factor != 1.0:
        rig = resized(rig, size.value.factor)
        located = locate_views(rig, solving_views(rig, boards), cameras.value)
        joined = _join_pairs(rig, located.value, cameras)
    sized = (*size.notes, *check_nominal_size(rig, joined.value.rig_from_camera))
    return _Solved(rig, sized, located, joined)


def _decode(
    rig: Rig,
    captures: Captures,
    boards: list[BoardView],
    cameras: Mapping[str, CameraCalibration],
    solving: Future[_Solved],
    located: list[LocatedView],
    through: Through,
    progress: Progress,
) -> Outcome[dict[ViewKey, BoardBoundaries]]:
    """Decode the stripes on the boards, where each camera by itself sees them.

    Of tens of millions of boundaries, only means on the print are kept, as many as light sheets are
    fitted to. A pair by itself, whose stripes also place the boards, keeps all of them.
    """
    known = {view.key: view for view in located}
    wanted = [view for view in boards if view.key in known]

    def print_of(view: BoardView) -> Box:
        return box_of_print(cameras[view.pair].camera, rig.board(view.board), known[view.key])

    def box(view: BoardView) -> Box:
        if solving.done():
            solving.result()  # once the joint solve has failed, nothing more is decoded
        return print_of(view)

    def printed(view: BoardView, seen: BoardBoundaries) -> BoardBoundaries:
        shot = StripedView(known[view.key], rig.board(view.board), seen)
        code = rig.pair(view.pair).projector
        assert code is not None
        return on_print(cameras[view.pair].camera, code, shot.board, shot.camera_from_face, seen)

    every = {
        pair.name: bands_apart(pair.projector, [print_of(v) for v in wanted if v.pair == pair.name])
        for pair in rig.pairs
        if pair.projector is not None and len(cameras) > 1
    }
    return decode_on_boards(
        rig, captures, wanted, progress, box=box, keep=printed, every=every, through=through
    )


def _fit_sheets(
    solving: Future[_Solved],
    cameras: Mapping[str, CameraCalibration],
    name: str,
    boundaries: Mapping[ViewKey, BoardBoundaries],
) -> Outcome[PairCalibration]:
    """Fit a pair's light sheets, once its pose is solved."""
    solved = solving.result()
    return calibrate_pair(
        _placed_pair(solved.rig, solved.joined.value, name, cameras[name], boundaries)
    )


def _fitted(
    fits: Mapping[str, Future[Outcome[PairCalibration]]], names: list[str], progress: Progress
) -> Outcome[dict[str, PairCalibration]]:
    fitted, errors = attempt_each(
        lambda name: fits[name].result(),
        names,
        BodyscanError,
        stage="fitting light sheets",
        progress=progress,
    )
    return Outcome(
        {name: found.value for name, found in fitted.items()},
        tuple(note for found in fitted.values() for note in found.notes),
        {name: format_error(error) for name, error in errors.items()},
    )


def striped(rig: Rig, placed: RigSolution, view: LocatedView, seen: BoardBoundaries) -> StripedView:
    """A view with its stripes and with its board's pose from the joint solve."""
    shape = placed.board_shapes.get(view.board)
    return StripedView(
        _as_solved(placed, view),
        rig.board(view.board),
        seen,
        shape.face(view.points) if shape else None,
    )


def _as_solved(placed: RigSolution, view: LocatedView) -> LocatedView:
    """A view with its board's pose from the joint solve."""
    camera_from_rig = placed.rig_from_camera[view.pair].inverse()
    return replace(view, camera_from_board=camera_from_rig @ placed.rig_from_board[view.target])


def _placed_pair(
    rig: Rig,
    placed: RigSolution,
    name: str,
    own: CameraCalibration,
    boundaries: Mapping[ViewKey, BoardBoundaries],
) -> PlacedPair:
    views = [view for view in placed.views if view.pair == name]
    shots = tuple(
        striped(rig, placed, view, boundaries[view.key]) for view in views if view.key in boundaries
    )
    return PlacedPair(
        name,
        placed.cameras[name],
        placed.camera_covariances.get(name, own.covariance),
        own,
        placed.lenses.get(name, own.lenses),
        rig.pair(name).projector,
        placed.rms_px[name],
        len(views),
        shots,
        alone=len(placed.cameras) == 1,
        rays=placed.rays.get(name, own.rays),
    )


def update_poses(rig: Rig, placed: RigSolution, pair: PairCalibration) -> RigSolution:
    """The solution with poses updated where a pair's stripes changed its camera.

    Camera and boards are as the new camera sees them; the board that fixes the rig frame stays
    where it is. Only a pair by itself is refined this way.
    """
    if pair.camera == placed.cameras[pair.name]:
        return placed
    seen = {
        view.target: locate_board(pair.camera, PlanarView(view.shot, view.points, view.pixels))[0]
        for view in placed.views
    }
    frame = frame_target(rig)
    rig_from_camera = (
        placed.rig_from_board[frame] @ seen[frame].inverse()
        if frame in seen
        else placed.rig_from_camera[pair.name]
    )
    return replace(
        placed,
        cameras={pair.name: pair.camera},
        rig_from_camera={pair.name: rig_from_camera},
        rig_from_board={target: rig_from_camera @ board for target, board in seen.items()},
    )
