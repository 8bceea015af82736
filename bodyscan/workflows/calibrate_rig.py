"""The rig's calibration, stage by stage: boards, cameras, one joint solve, light sheets."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

from bodyscan.boards.board import corner_points
from bodyscan.boards.detection import find_boards
from bodyscan.boards.view import BoardView
from bodyscan.calibration.camera import (
    CameraCalibration,
    PlanarView,
    calibrate_camera,
    locate_board,
)
from bodyscan.calibration.coverage import coverage_notes
from bodyscan.calibration.located_view import LocatedView, board_symmetries
from bodyscan.calibration.pair import (
    PairCalibration,
    planar_view,
    usable,
)
from bodyscan.captures.folder import Captures, ImageSequence
from bodyscan.captures.images import read_lit
from bodyscan.errors import BadInput, BodyscanError, FailedWork
from bodyscan.progress import Progress, silent, threaded
from bodyscan.registration.advice import advise
from bodyscan.registration.board_doubts import boards_not_found, size_doubt, what_was_found
from bodyscan.registration.halves import compare_halves
from bodyscan.registration.rig_calibration import RigCalibration
from bodyscan.registration.rig_frame import frame_target
from bodyscan.registration.rig_solve import PlacedRig, place_rig
from bodyscan.registration.seen_corners import seen_corners
from bodyscan.rig.board import Board
from bodyscan.rig.rig import Rig
from bodyscan.workflows.calibrate_pairs import calibrate_pairs
from bodyscan.workflows.decode_boards import decode_on_boards


def calibrate_rig(rig: Rig, captures: Captures, progress: Progress = silent) -> RigCalibration:
    """Board images in, calibrated rig out.

    A bad image or pair costs that image or pair and is named in `failed` or `notes`.  Raises
    FailedWork if no pair is left, RigDisconnected if the pairs do not hang together, BadInput if
    nothing fixes the rig frame.
    """
    boards = {board.name: board for board in rig.boards}
    notes: list[str] = []
    views = find_all_boards(rig, captures, notes, progress)
    notes += coverage_notes(rig, views)
    notes += boards_not_found(rig, views, len(captures.sequences))
    cameras, failed = calibrate_cameras(rig, views, boards, progress)
    if not cameras:
        remedy = what_was_found(rig, views, len(captures.sequences))
        raise _nothing_calibrated(rig, failed, remedy)
    progress("joining the pairs", 0, 1)
    located = locate_views(views, cameras, boards, notes)
    try:
        placed = place_rig(rig, located, {name: c.camera for name, c in cameras.items()})
    except BadInput as error:
        # The board or pair that fixes the frame may be missing because pairs failed before.
        before = "; ".join(f"{name}: {reason}" for name, reason in failed.items())
        remedy = f"{error.remedy}\n  left out before: {before}" if before else error.remedy
        raise BadInput(error.what, where=error.where, remedy=remedy) from error
    failed |= placed.left_out
    notes += size_doubt(rig, placed.rig_from_camera)
    cameras = {name: own for name, own in cameras.items() if name in placed.rig_from_camera}
    progress("joining the pairs", 1, 1)
    decoded = decode_on_boards(rig, captures, placed, views, progress)
    notes += decoded.notes
    failed |= decoded.failed
    cameras = {name: own for name, own in cameras.items() if name not in failed}
    pairs = calibrate_pairs(rig, cameras, placed, decoded.boundaries, failed, notes, progress)
    if not pairs:
        raise _nothing_calibrated(rig, failed)
    for pair in pairs.values():
        placed = placed_again(rig, placed, pair)
    return RigCalibration(
        rig,
        pairs,
        {name: placed.rig_from_camera[name] for name in pairs},
        placed.covariance,
        placed.rig_from_board,
        failed,
        (*notes, *placed.notes),
        (*(advice_on(rig, placed, progress) if not failed else ()), *through_the_stripes(pairs)),
        seen_corners(placed, pairs),
    )


def _nothing_calibrated(rig: Rig, failed: Mapping[str, str], remedy: str = "") -> FailedWork:
    reasons = "".join(f"\n  {name}: {reason}" for name, reason in failed.items())
    return FailedWork(
        f"no pair could be calibrated:{reasons}", where=f"rig {rig.name}", remedy=remedy
    )


def advice_on(rig: Rig, placed: PlacedRig, progress: Progress = silent) -> tuple[str, ...]:
    """How well the pairs are tied together, whether halves of the shots agree, and what would help
    most; nothing for one pair."""
    if len(placed.rig_from_camera) < 2:
        return ()
    progress("advice", 0, 1)
    said = advise(rig, placed).lines
    try:
        said.append(compare_halves(rig, placed).summary)
    except FailedWork as error:
        said.append(f"the rig cannot be placed from halves of its shots: {error.what}")
    progress("advice", 1, 1)
    return tuple(said)


def through_the_stripes(pairs: Mapping[str, PairCalibration]) -> Iterator[str]:
    """A line on whether stripes measure the boards where the corners put them."""
    boards = {n: p.quality.boards_mm for n, p in pairs.items() if p.quality.boards_mm is not None}
    if boards:
        worst = max(sorted(boards), key=lambda name: boards[name][1])
        mean = sum(mean for mean, _ in boards.values()) / len(boards)
        rms = (sum(rms**2 for _, rms in boards.values()) / len(boards)) ** 0.5
        yield (
            f"measured by the stripes, boards lie {mean:+.3f} mm (mean) and {rms:.3f} mm (RMS) from "
            f"where the corners put them; worst: {worst}, {boards[worst][1]:.3f} mm"
        )


def placed_again(rig: Rig, placed: PlacedRig, pair: PairCalibration) -> PlacedRig:
    """Where a pair's stripes changed its camera: camera and boards as that camera sees them, the
    board that fixes the rig frame where it lies. Only a pair by itself is refined so."""
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


def find_all_boards(
    rig: Rig, captures: Captures, notes: list[str], progress: Progress = silent
) -> list[BoardView]:
    """Boards in all lit images; images that cannot be read, or show no board, go into `notes`."""

    def find(sequence: ImageSequence) -> tuple[list[BoardView], str | None]:
        where = f"{sequence.lit} (pair {sequence.pair}, shot {sequence.shot})"
        try:
            image = read_lit(sequence, rig.pair(sequence.pair).camera)
            found = find_boards(image, rig.boards, pair=sequence.pair, shot=sequence.shot)
        except BodyscanError as error:
            return [], str(error)
        return found, None if found else f"{where}: no board found"

    results = threaded(find, captures.sequences, stage="finding boards", progress=progress)
    notes += [note for _, note in results if note]
    return [view for found, _ in results for view in found]


def calibrate_cameras(
    rig: Rig,
    views: Sequence[BoardView],
    boards: Mapping[str, Board],
    progress: Progress = silent,
) -> tuple[dict[str, CameraCalibration], dict[str, str]]:
    """Every pair's camera by itself; pairs that fail, with the reason."""

    def calibrate(name: str) -> CameraCalibration | str:
        spec = rig.pair(name).camera
        own = [v for v in views if v.pair == name and usable(v, boards[v.board])]
        try:
            return calibrate_camera(
                [planar_view(view, boards[view.board]) for view in own], spec.width, spec.height
            )
        except BodyscanError as error:
            return str(error)

    names = [pair.name for pair in rig.pairs]
    results = threaded(calibrate, names, stage="calibrating cameras", progress=progress)
    done = {n: r for n, r in zip(names, results, strict=True) if isinstance(r, CameraCalibration)}
    failed = {n: r for n, r in zip(names, results, strict=True) if isinstance(r, str)}
    return done, failed


def locate_views(
    views: Sequence[BoardView],
    cameras: Mapping[str, CameraCalibration],
    boards: Mapping[str, Board],
    notes: list[str],
) -> list[LocatedView]:
    """The pose of each board in the camera that saw it; views that fit no pose are dropped."""
    located = []
    for view in views:
        board = boards[view.board]
        if view.pair not in cameras or not usable(view, board):
            continue
        pose, residuals = locate_board(cameras[view.pair].camera, planar_view(view, board))
        rms = float((residuals**2).sum(axis=1).mean() ** 0.5)
        if rms > max(1.0, 6.0 * cameras[view.pair].rms_px):
            notes.append(
                f"{view.pair}: board {board.name} in shot {view.shot} fits no pose ({rms:.2f} px); "
                "not used"
            )
            continue
        symmetries = board_symmetries(board) if view.turnable else board_symmetries(board)[:1]
        located.append(
            LocatedView(
                view.pair,
                view.shot,
                view.board,
                corner_points(board)[view.corner_ids],
                view.pixels,
                pose,
                symmetries,
            )
        )
    return located
