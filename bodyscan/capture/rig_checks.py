"""What a rig file must satisfy beyond each value by itself; every check names the place to mend."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from bodyscan.capture.dictionaries import MARKERS_IN, family
from bodyscan.capture.model import Problem, duplicates
from bodyscan.capture.templates import frame_name_faults, path_fault, template_faults

if TYPE_CHECKING:
    from bodyscan.capture.rig import (
        Board,
        CaptureFolder,
        FrameKind,
        FrameNames,
        Pair,
        ProjectorSpec,
        Rig,
        RigFrame,
    )

NUMBERED: dict[FrameKind, str] = {
    "pattern": "bit",
    "inverse": "bit",
    "phase": "step",
    "stripe": "stripe",
}
"""Kinds of images of which there are several, and what numbers them."""

_MOST = {"bit": 16, "step": 64, "stripe": 1000}
_LARGEST_INDEX = 254


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """` (did you mean 'x'?)` for the nearest of the known words, or nothing."""
    near = difflib.get_close_matches(word, list(known), n=1, cutoff=0.6)
    return f" (did you mean '{near[0]}'?)" if near else ""


def board_problems(board: Board) -> Iterator[Problem]:
    if board.faces == 1 and board.thickness_mm > 0:
        yield ("thickness_mm",), "is for a board with faces: 2 (it is between the two prints)"
    if board.kind == "checkerboard":
        if board.marker_mm is not None:
            yield ("marker_mm",), "is for kind: charuco; a checkerboard has no markers"
        return
    if board.marker_mm is None:
        yield ("marker_mm",), "is missing: a charuco board needs the side of its markers"
    elif board.marker_mm >= board.square_mm:
        wrong = f"must be less than square_mm ({board.square_mm:g}) (got {board.marker_mm:g})"
        yield ("marker_mm",), wrong
    if board.dictionary not in MARKERS_IN:
        hint = did_you_mean(board.dictionary, MARKERS_IN)
        yield ("dictionary",), f"is no dictionary of OpenCV{hint} (got {board.dictionary!r})"
    elif board.first_marker + board.marker_count > MARKERS_IN[board.dictionary]:
        end = board.first_marker + board.marker_count - 1
        held = MARKERS_IN[board.dictionary]
        yield (
            ("dictionary",),
            f"holds markers 0 to {held - 1}, but this board needs {board.first_marker} to {end}",
        )


def projector_problems(projector: ProjectorSpec) -> Iterator[Problem]:
    code = projector.code
    if projector.inverses is not None and not projector.bits:
        yield ("inverses",), f"is for codes with bits; {code} has none"
    if code == "stripe-index" and projector.stripes > _LARGEST_INDEX:
        wrong = f"must be {_LARGEST_INDEX} or less for stripe-index (got {projector.stripes})"
        yield ("stripes",), wrong
    if code != "phase-shift":
        for key in ("steps", "period"):
            if getattr(projector, key) is not None:
                yield (key,), f"is for code: phase-shift (the code here is {code})"
    elif projector.period_stripes > projector.stripes:
        wrong = f"must be {projector.stripes} (stripes) or less (got {projector.period_stripes})"
        yield ("period",), wrong


def frame_problems(frames: FrameNames) -> Iterator[Problem]:
    all_names = []
    for kind, name in (("lit", frames.lit), ("dark", frames.dark), ("index", frames.index)):
        fault = path_fault(name) if name is not None else None
        if fault:
            yield (kind,), fault
        all_names.append(name)
    for kind, number in NUMBERED.items():
        names = getattr(frames, kind)
        faults = list(_numbered_name_faults(kind, number, names))
        yield from faults
        if not faults and isinstance(names, str):
            all_names += [names.format(**{number: i}) for i in range(_MOST[number])]
        elif not faults:
            all_names += names
    for _, twice in duplicates(tuple(all_names)):
        yield (), f"gives two images the same name ({twice!r})"


def _numbered_name_faults(
    kind: str, number: str, names: str | tuple[str, ...]
) -> Iterator[Problem]:
    if isinstance(names, str):
        for fault in [*frame_name_faults(names, number), *filter(None, [path_fault(names)])]:
            yield (kind,), fault
        return
    for index, name in enumerate(names):
        wrong = path_fault(name)
        if wrong:
            yield (kind, index), wrong


def rig_frame_problems(frame: RigFrame) -> Iterator[Problem]:
    if frame.shot is not None and frame.pair is not None:
        yield ("pair",), "cannot fix the rig frame together with shot: give one of the two"
    if frame.board is not None and frame.shot is None:
        yield ("board",), "needs shot: the shot in which this board fixes the rig frame"
    lengths = {key: math.hypot(*getattr(frame, key)) for key in ("x_axis", "y_axis")}
    for key, length in lengths.items():
        if length == 0:
            yield (key,), "must not be zero"
    cosine = sum(x * y for x, y in zip(frame.x_axis, frame.y_axis, strict=True))
    if all(lengths.values()) and abs(cosine) > 1e-6 * lengths["x_axis"] * lengths["y_axis"]:
        yield ("y_axis",), "must be perpendicular to x_axis"


@dataclass(frozen=True)
class RigParts:
    """The parts of a rig file that are right by themselves; None stands for one that is not."""

    board_names: tuple[str | None, ...]
    boards: tuple[Board | None, ...]
    pair_names: tuple[str | None, ...]
    pairs: tuple[Pair | None, ...]
    folders: tuple[CaptureFolder | None, ...]
    files: str | None
    frames: FrameNames | None
    rig_frame: RigFrame | None

    @staticmethod
    def of(rig: Rig) -> RigParts:
        """All parts of a rig."""
        return RigParts(
            board_names=tuple(board.name for board in rig.boards),
            boards=rig.boards,
            pair_names=tuple(pair.name for pair in rig.pairs),
            pairs=rig.pairs,
            folders=rig.calibration,
            files=rig.files,
            frames=rig.frames,
            rig_frame=rig.rig_frame,
        )


def rig_problems(parts: RigParts) -> Iterator[Problem]:
    """What does not fit together in a rig file."""
    for key, names in (("boards", parts.board_names), ("pairs", parts.pair_names)):
        for index, name in duplicates(names):
            yield (key, index, "name"), f"is given to two {key}: every name once (got {name!r})"
    yield from _marker_overlaps(parts.boards)
    yield from _wrong_frames(parts)
    yield from _template_problems(parts)
    yield from _unknown_references(parts)


def _marker_overlaps(boards: Sequence[Board | None]) -> Iterator[Problem]:
    taken: list[tuple[Board, range]] = []
    for index, board in enumerate(boards):
        if board is None or board.kind != "charuco":
            continue
        own = range(board.first_marker, board.first_marker + board.marker_count)
        for other, theirs in taken:
            shared = range(max(own.start, theirs.start), min(own.stop, theirs.stop))
            if family(other.dictionary) == family(board.dictionary) and shared:
                yield (
                    ("boards", index, "first_marker"),
                    f"gives board {board.name} markers {own.start} to {own.stop - 1}, of which"
                    f" board {other.name} has {shared.start} to {shared.stop - 1} as well:"
                    f" print it with first_marker {theirs.stop} or more",
                )
        taken.append((board, own))


def _wrong_frames(parts: RigParts) -> Iterator[Problem]:
    projectors = [(pair.name, pair.projector) for pair in parts.pairs if pair and pair.projector]
    for kind, number in NUMBERED.items():
        names = getattr(parts.frames, kind, "")
        if isinstance(names, str):
            continue
        for pair, projector in projectors:
            count = projector.frame_counts.get(kind, len(names))
            if count != len(names):
                yield (
                    ("frames", kind),
                    f"has {len(names)} names, but the {projector.stripes} stripes of pair"
                    f" {pair} take {count} {number}s",
                )
                break
    if parts.frames is None or parts.frames.dark is not None:
        return
    for pair, projector in projectors:
        if projector.bits and not projector.has_inverses:
            wrong = f"is needed: pair {pair} takes no inverses, so only it shows what black is"
            yield ("frames", "dark"), wrong
            break


def _template_problems(parts: RigParts) -> Iterator[Problem]:
    many = len(parts.pairs) > 1
    stripes = any(pair and pair.projector for pair in parts.pairs)
    if parts.files is not None:
        for fault in template_faults(parts.files, many_pairs=many, needs_frame=stripes):
            yield ("files",), fault
    for index, folder in enumerate(parts.folders):
        if folder and folder.files is not None:
            for fault in template_faults(folder.files, many_pairs=many, needs_frame=False):
                yield ("calibration", index, "files"), fault
    places = tuple(folder.folder.rstrip("/") if folder else None for folder in parts.folders)
    for index, place in duplicates(places):
        yield ("calibration", index, "folder"), f"is listed twice (got {place!r})"


def _unknown_references(parts: RigParts) -> Iterator[Problem]:
    frame = parts.rig_frame
    if frame is None:
        return
    for key, names in (("pair", parts.pair_names), ("board", parts.board_names)):
        wanted = getattr(frame, key)
        if wanted is not None and wanted not in names:
            hint = did_you_mean(wanted, filter(None, names))
            yield ("rig_frame", key), f"names no {key} of this file{hint} (got {wanted!r})"
    if frame.shot is not None and frame.board is None and len(parts.boards) > 1:
        yield ("rig_frame", "board"), "is missing: say which of the boards fixes the rig frame"
