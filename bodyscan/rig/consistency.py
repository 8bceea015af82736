"""What must fit together in a rig file whose parts are right by themselves."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from bodyscan.files.model import Problem, did_you_mean, duplicates
from bodyscan.rig.board import Board, family
from bodyscan.rig.capture_folder import CaptureFolder
from bodyscan.rig.frame_names import FrameNames
from bodyscan.rig.pair import Pair
from bodyscan.rig.rig_frame import RigFrame
from bodyscan.rig.templates import template_faults
from bodyscan.stripes.codes import image_kinds


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
    if parts.frames is None:
        return
    for kind in image_kinds():
        names = parts.frames.given(kind)
        if isinstance(names, str):
            continue
        for pair, code in projectors:
            count = code.image_counts.get(kind, len(names))
            if count != len(names):
                yield (
                    ("frames", kind.name),
                    f"has {len(names)} names, but the {code.stripes} stripes of pair"
                    f" {pair} take {count} {kind.number}s",
                )
                break
    if parts.frames.dark is not None:
        return
    for pair, code in projectors:
        if code.needs_dark:
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
