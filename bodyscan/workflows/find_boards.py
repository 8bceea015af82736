"""Find boards in all lit images, calibrate cameras from them, and find each view's board pose."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from bodyscan.arrays import Array
from bodyscan.boards.board_layout import compute_corner_grid, compute_corner_points
from bodyscan.boards.detection import find_boards
from bodyscan.boards.detection_failure import (
    Unfound,
    describe_unfound,
    detect_any,
    estimate_first_marker,
)
from bodyscan.boards.view import BoardView, ViewKey, number_corners
from bodyscan.calibration.board_views import (
    LocatedView,
    find_board_symmetries,
    has_enough_corners,
    make_planar_view,
)
from bodyscan.calibration.camera import (
    MIN_POSES,
    CameraCalibration,
    calibrate_known_camera,
    estimate_pose,
    locate_boards,
)
from bodyscan.calibration.known_pair import read_known_camera
from bodyscan.calibration.lens_selection import calibrate_widest
from bodyscan.captures.folder import Captures, ImageSequence
from bodyscan.captures.images import measure_mosaic, read_board_image, read_sequence
from bodyscan.errors import (
    BadInput,
    BodyscanError,
    DegeneratePoses,
    FailedWork,
    format_list,
    group_reasons,
)
from bodyscan.files.corners_vnl import Corners, write_corners
from bodyscan.geometry.lenses import FAMILY, LENSES
from bodyscan.geometry.robust import compute_rms_length
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.outcome import Outcome
from bodyscan.progress import Progress, attempt_each, map_threads, silent
from bodyscan.registration.board_checks import (
    describe_findings,
    note_appearance,
    refuse_other_pitch,
)
from bodyscan.registration.sanity_checks import find_camera_faults
from bodyscan.rig.board import Board
from bodyscan.rig.gauge import RigFrame
from bodyscan.rig.pair import AUTO, Pair
from bodyscan.rig.rig import Rig
from bodyscan.stripes.decoding import describe_step

HERE = Path()
LOOKED_AT = 3
"""Images without a board, per pair, that are examined closely: seconds each."""


@dataclass(frozen=True, eq=False)
class FoundBoards(Outcome[list[BoardView]]):
    """The boards found.

    refused: images in which no board could be looked for, each with the error.
    unfound: what images without a board show, of those that were looked at closely.
    """

    refused: Mapping[ImageSequence, BodyscanError] = field(default_factory=dict)
    unfound: Mapping[ImageSequence, Unfound] = field(default_factory=dict)

    def count_searched(self, captures: Captures) -> int:
        """Count the images in which boards were looked for."""
        return len(captures.sequences) - len(self.refused)


def find_all_boards(
    rig: Rig, captures: Captures, progress: Progress = silent, *, explain: bool = True
) -> FoundBoards:
    """Find boards in the board image of every sequence: the lit one, or one taken for the board.

    Images that cannot be read, or that show no board, become notes, which `explain` why they do.
    """

    first = {sequence.pair: sequence for sequence in reversed(captures.sequences)}
    mosaics: dict[str, float] = {}

    def find(sequence: ImageSequence) -> list[BoardView]:
        if sequence.board_path in captures.corners:
            return _read_given_view(rig, captures, sequence)
        image = read_board_image(sequence, rig.pair(sequence.pair))
        if first[sequence.pair] is sequence:
            mosaics[sequence.pair] = measure_mosaic(image)
        return find_boards(image, rig.boards, pair=sequence.pair, shot=sequence.shot)

    found, refused = attempt_each(
        find, captures.sequences, BodyscanError, stage="finding boards", progress=progress
    )
    views = [view for each in found.values() for view in each]
    for board in rig.boards:
        refuse_other_pitch(board, views)
        _refuse_other_markers(rig, captures, board, views)
    without = [s for s, each in found.items() if not each and s.board_path not in captures.corners]
    unfound = _look_closer(rig, views, without) if explain else {}
    by_pair = {s.pair: [one for one in without if one.pair == s.pair] for s in without}
    missing = [_note_without(images, list(found), unfound) for images in by_pair.values()]
    raw = [
        f"{pair}: neighbouring pixels differ by {differ:.0%} in squares of 2 x 2, as in a raw Bayer "
        "image, which is not grey: demosaic the images first"
        for pair, differ in sorted(mosaics.items())
        if differ > 0.05  # of grey images 0.01 at most
    ]
    notes = (*map(str, refused.values()), *missing, *raw, *note_appearance(rig, views))
    return FoundBoards(views, notes, refused=refused, unfound=unfound)


def _note_without(
    images: Sequence[ImageSequence],
    searched: Sequence[ImageSequence],
    unfound: Mapping[ImageSequence, Unfound],
) -> str:
    """One line for the images of one pair without a board, with what those that were looked at show."""
    groups = group_reasons((one, unfound[one].text) for one in images if one in unfound)
    if len(images) == 1:
        return "".join([_format_without(images[0]), *(f": {text}" for _, text in groups)])
    pair, names = images[0].pair, [one.shot for one in images]
    shots = ", ".join(names if len(names) <= 6 else [*names[:5], "..."])
    taken = sum(one.pair == pair for one in searched)
    described = "".join(f"; shot {some[0].shot}: {text}" for some, text in groups)
    return f"{pair}: no board found in {len(images)} of {taken} images, shots {shots}{described}"


def _format_without(image: ImageSequence) -> str:
    return f"{image.board_path} (pair {image.pair}, shot {image.shot}): no board found"


def _refuse_other_markers(
    rig: Rig, captures: Captures, board: Board, views: Sequence[BoardView]
) -> None:
    """Raise BadInput if the markers of an image name another first marker than the rig file.

    They are looked at again only if the best view lacks a border of the corners, as where numbers are
    shifted: of a row of markers then those agree that do not wrap into the next.
    """
    found = (view for view in views if view.board == board.name)
    best = max(found, key=lambda view: len(view.pixels), default=None)
    if board.kind == "checkerboard" or best is None:
        return
    columns, rows = compute_corner_grid(board)
    ids = best.corner_ids % (columns * rows)
    whole = {0, columns - 1} <= set(ids % columns) and {0, rows - 1} <= set(ids // columns)
    pair, shot, _ = best.key
    sequence = next(s for s in captures.pair_sequences(pair) if s.shot == shot)
    if whole or sequence.board_path in captures.corners:
        return
    markers, _ = detect_any(read_board_image(sequence, rig.pair(pair)), board)
    first = estimate_first_marker(board, markers)
    if first != board.first_marker:
        raise BadInput(
            f"markers lie as on this board with first_marker {first}, not {board.first_marker}",
            where=f"board {board.name}: {sequence.board_path}",
            remedy="correct first_marker in the rig file",
        )


def choose_frame(rig: Rig, captures: Captures) -> Outcome[Rig]:
    """The rig with a frame that its captures can fix: where no image of the shot that is to fix it
    shows the board, a pair at its nominal pose does instead, with a note; else BadInput is raised."""
    shot, board = rig.rig_frame.shot, rig.frame_board
    if shot is None or board is None:
        return Outcome(rig)
    for sequence in captures.shot_sequences(shot):
        if captures.corners.get(sequence.board_path):
            return Outcome(rig)
        with suppress(BodyscanError):  # images that cannot be read are told of together
            image = read_board_image(sequence, rig.pair(sequence.pair))
            if find_boards(image, [board], pair=sequence.pair, shot=shot):
                return Outcome(rig)
    fault = (
        f"rig_frame.shot: no image of '{shot}' shows board {board.name}, which fixes the rig frame"
    )
    holder = next((pair for pair in rig.pairs if pair.nominal), None)
    if holder is None:
        raise BadInput(
            fault,
            where=f"rig {rig.name}",
            remedy="capture it again, lit and in view of a camera, or name a pair in rig_frame",
        )
    frame = RigFrame() if holder is rig.pairs[0] else RigFrame(pair=holder.name)
    note = f"{fault}; pair {holder.name} at its nominal pose does: heights are as exact as that"
    return Outcome(rig.model_copy(update={"rig_frame": frame}), (note,))


def _read_given_view(rig: Rig, captures: Captures, sequence: ImageSequence) -> list[BoardView]:
    """The board whose corners were found elsewhere, [] if none were. Raises BadInput when the rig has
    several boards, because corners alone do not identify the board."""
    if len(rig.boards) != 1:
        raise BadInput(
            f"corners are given, but the rig has {len(rig.boards)} boards",
            where=f"rig {rig.name}",
            remedy="Corners found elsewhere are those of one board: describe that one alone.",
        )
    camera = rig.pair(sequence.pair).camera
    pixels = np.array(captures.corners[sequence.board_path]).reshape(-1, 2)
    view = number_corners(
        pixels, rig.boards[0], (camera.width, camera.height),
        pair=sequence.pair, shot=sequence.shot, where=str(sequence.board_path),
    )  # fmt: skip
    return [] if view is None else [view]


def write_found_corners(
    path: Path, rig: Rig, captures: Captures, views: Sequence[BoardView]
) -> None:
    """Write the corners of the rig's only board in every image as corners.vnl.

    Images are named by their path in the capture folder. Nothing is written of a rig with more boards.
    """
    if len(rig.boards) != 1:
        return
    count = len(compute_corner_points(rig.boards[0]))
    by_sequence = {(view.pair, view.shot): view for view in views}

    def row(sequence: ImageSequence) -> tuple[str, Corners]:
        image = sequence.board_path
        inside = [folder for folder in captures.folders if image.is_relative_to(folder)]
        name = image.relative_to(inside[0]).as_posix() if inside else image.name
        view = by_sequence.get((sequence.pair, sequence.shot))
        if view is None:
            return name, ()
        pixels = np.full((count, 2), np.nan)
        pixels[view.corner_ids] = view.pixels
        return name, tuple(map(tuple, pixels.tolist()))

    write_corners(path, map(row, captures.sequences))


def _look_closer(
    rig: Rig, views: Sequence[BoardView], without: Sequence[ImageSequence]
) -> dict[ImageSequence, Unfound]:
    """What images without a board do show: closely for pairs that saw few boards or missed few, at a
    glance for those that saw most."""
    chosen: list[tuple[ImageSequence, bool]] = []
    for pair in rig.pairs:
        images = [sequence for sequence in without if sequence.pair == pair.name]
        found = sum(view.pair == pair.name for view in views)
        if found < MIN_POSES or len(images) <= LOOKED_AT:
            chosen += [(one, False) for one in images[:LOOKED_AT]]
        elif found > len(images):
            chosen += [(one, True) for one in images]

    def look(one: tuple[ImageSequence, bool]) -> Unfound:
        sequence, quick = one
        pair = rig.pair(sequence.pair)
        if pair.projector and sequence.has_stripes and not sequence.missing:
            images = read_sequence(sequence.without_crossing, pair.camera)
            step = describe_step(pair.projector, images.lit, images.dark, images.coded)
            if step:
                return Unfound(step, is_cause=True)
        image = read_board_image(sequence, pair)
        each = {one.name: describe_unfound(image, one, quick=quick) for one in rig.boards}
        text = "; ".join(f"{name}: {one.text}" for name, one in each.items() if one.text)
        return Unfound(text, any(one.is_cause for one in each.values()))

    looks = map_threads(look, chosen)
    return {one: look for (one, _), look in zip(chosen, looks, strict=True) if look.text}


def calibrate_cameras(
    rig: Rig, views: Sequence[BoardView], progress: Progress = silent, *, folder: Path = HERE
) -> Outcome[dict[str, CameraCalibration]]:
    """Calibrate every pair's camera by itself; those that fail are in `failures`.

    What is `known` of a camera is read from files relative to `folder`, and held fixed or used as a
    start. The lens is the one that the rig file names; otherwise the richest: the solve chooses.
    """

    def calibrate(name: str) -> CameraCalibration:
        found = fit(name)
        for where, what in find_camera_faults(found.camera, rig.pair(name), "camera"):
            raise DegeneratePoses(
                f"the best fit to its boards is not a possible camera: {where} {what}",
                remedy="Possible causes: corners are mixed up in some of its views, or its boards are "
                "not as described. Leave out the shots in doubt",
            )
        return found

    def fit(name: str) -> CameraCalibration:
        spec = rig.pair(name).camera
        planar = [
            make_planar_view(view, rig.board(view.board))
            for view in views
            if view.pair == name and has_enough_corners(view, rig.board(view.board))
        ]
        if rig.pair(name).known is not None:
            return calibrate_known_camera(planar, read_known_camera(rig.pair(name), folder))
        kinds = FAMILY if spec.lens == AUTO else (LENSES[spec.lens],)
        return calibrate_widest(kinds, planar, spec.width, spec.height)

    names = [pair.name for pair in rig.pairs]
    cameras, errors = attempt_each(
        calibrate, names, BodyscanError, stage="calibrating cameras", progress=progress
    )
    notes = [line for name, found in cameras.items() for line in _note_known(rig.pair(name), found)]
    failures = {name: str(error) for name, error in errors.items()}
    return Outcome(cameras, tuple(notes), failures)


def _note_known(pair: Pair, found: CameraCalibration) -> Iterator[str]:
    known, name = pair.known, pair.name
    if known is None:
        return
    use = "fixed" if known.sigma_px is None else f"a prior of sigma {known.sigma_px:g} px"
    yield f"{name}: camera from {known.file} ({known.format}), {use}"
    if found.rms_px > 1.0:
        yield (
            f"{name}: boards fit the camera from {known.file} only to {found.rms_px:.1f} px RMS. "
            "Possible causes: the file is another camera's, or focus or zoom have changed since"
        )


def require_cameras(
    rig: Rig,
    captures: Captures,
    boards: FoundBoards,
    cameras: Outcome[dict[str, CameraCalibration]],
) -> Outcome[dict[str, CameraCalibration]]:
    """The cameras, with the reasons of those that failed traced back to their images.

    Raises FailedWork if there is none.
    """
    searched, failures = boards.count_searched(captures), dict(cameras.failures)
    if searched and not boards.value:
        # More poses of a board that is not as described would not help.
        failures = {name: reason.partition("\n")[0] for name, reason in failures.items()}
    for name in failures:
        taken = sum(sequence.pair == name for sequence in captures.sequences)
        errors = [error for sequence, error in boards.refused.items() if sequence.pair == name]
        if errors and taken - len(errors) < MIN_POSES:
            # The most common error: when images are few, one may be bad for a reason of its own.
            error = max(errors, key=lambda one: sum(each.what == one.what for each in errors))
            failures[name] = f"{len(errors)} of its {taken} images cannot be used: {error}"
    if not cameras.value:
        raise make_no_pair_error(rig, failures, _describe_boardless(rig, boards, searched))
    return replace(cameras, failures=failures)


def make_no_pair_error(rig: Rig, failed: Mapping[str, str], remedy: str = "") -> FailedWork:
    """The error when no pair could be calibrated: in a rig with projectors, none that has one."""
    of_rig = "pair with a projector" if any(pair.projector for pair in rig.pairs) else "pair"
    what = f"no {of_rig} could be calibrated:{format_list(failed)}"
    return FailedWork(what, where=f"rig {rig.name}", remedy=remedy)


def _describe_boardless(rig: Rig, boards: FoundBoards, searched: int) -> str:
    """What images without the described board show instead: one image for each kind of finding,
    whatever the number of markers counted."""
    notes = {one: f"{_format_without(one)}: {look.text}" for one, look in boards.unfound.items()}
    for one, look in boards.unfound.items():
        if look.is_cause:
            return notes[one]
    groups = group_reasons((one, look.text) for one, look in boards.unfound.items())
    findings = describe_findings(rig, boards.value, searched)
    return "\n  ".join([*filter(None, [findings]), *(notes[some[0]] for some, _ in groups[:3])])


def locate_views(
    rig: Rig, views: Sequence[BoardView], cameras: Mapping[str, CameraCalibration]
) -> Outcome[list[LocatedView]]:
    """Find the pose of each board in the camera that saw it; drop views that fit no pose."""
    usable = [
        view
        for view in views
        if view.pair in cameras and has_enough_corners(view, rig.board(view.board))
    ]
    fitted: dict[ViewKey, tuple[RigidTransform, Array]] = {}
    for name, found in cameras.items():
        # All at once: solving for one board's pose takes as many calls as for thirty.
        of_camera = [view for view in usable if view.pair == name]
        planar = [make_planar_view(view, rig.board(view.board)) for view in of_camera]
        starts = [estimate_pose(found.camera, view) for view in planar]
        poses = zip(*locate_boards(found.camera, planar, starts), strict=True) if planar else ()
        fitted |= zip((view.key for view in of_camera), poses, strict=True)
    located, notes = [], []
    for view in usable:
        board, (pose, residuals) = rig.board(view.board), fitted[view.key]
        rms = compute_rms_length(residuals)
        # Real corners are good to a few tenths of a pixel: this is another board, or a mix-up.
        if rms > max(1.0, 6.0 * cameras[view.pair].rms_px):
            notes.append(
                f"{view.pair}: board {board.name} in shot {view.shot}: no pose fits (RMS "
                f"{rms:.2f} px): view discarded, corners may be misnumbered"
            )
            continue
        symmetries = (
            find_board_symmetries(board) if view.turnable else find_board_symmetries(board)[:1]
        )
        points = compute_corner_points(board)[view.corner_ids]
        located.append(
            LocatedView(view.pair, view.shot, view.board, points, view.pixels, pose, symmetries)
        )
    return Outcome(located, tuple(notes))
