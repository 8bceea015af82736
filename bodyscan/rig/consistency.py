"""What must fit together in a rig file whose parts are valid by themselves."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from bodyscan.files.model import Problem, did_you_mean, find_duplicates
from bodyscan.rig.board import Board, dictionary_family
from bodyscan.rig.frame_names import CaptureFolder, FrameNames, ImageNames
from bodyscan.rig.pair import Pair
from bodyscan.rig.rig_frame import Reference, RigFrame
from bodyscan.rig.templates import template_faults
from bodyscan.stripes.codes import image_kinds
from bodyscan.stripes.stripe_code import StripeCode


@dataclass(frozen=True)
class RigParts:
    """The parts of a rig file that are valid by themselves; None stands for one that is not."""

    board_names: tuple[str | None, ...]
    boards: tuple[Board | None, ...]
    pair_names: tuple[str | None, ...]
    pairs: tuple[Pair | None, ...]
    folders: tuple[CaptureFolder | None, ...]
    references: tuple[Reference | None, ...]
    files: str | None
    exposures: tuple[str, ...]
    frames: FrameNames | None
    rig_frame: RigFrame | None


def rig_problems(parts: RigParts) -> Iterator[Problem]:
    """Find the parts of a rig file that do not fit together."""
    for key, names in (("boards", parts.board_names), ("pairs", parts.pair_names)):
        for index, name in find_duplicates(names):
            yield (key, index, "name"), f"is given to two {key}: every name once (got {name!r})"
    if parts.folders and not parts.boards:
        yield ("boards",), "is missing: calibration captures show a board"
    yield from _find_marker_overlaps(parts.boards)
    yield from _find_wrong_frames(parts)
    yield from _find_template_problems(parts)
    yield from _find_unknown_references(parts)
    yield from _find_wrong_references(parts)


def _find_marker_overlaps(boards: Sequence[Board | None]) -> Iterator[Problem]:
    taken: list[tuple[Board, range]] = []
    for index, board in enumerate(boards):
        if board is None or board.kind == "checkerboard":
            continue
        ids = range(board.first_marker, board.first_marker + board.marker_count)
        for other, theirs in taken:
            shared = range(max(ids.start, theirs.start), min(ids.stop, theirs.stop))
            family, its = dictionary_family(other.dictionary), dictionary_family(board.dictionary)
            if shared and family == its:
                yield (
                    ("boards", index, "first_marker"),
                    f"gives board {board.name} markers {ids.start} to {ids.stop - 1}, of which"
                    f" board {other.name} has {shared.start} to {shared.stop - 1} as well:"
                    f" print it with first_marker {theirs.stop} or more",
                )
        taken.append((board, ids))


def _find_wrong_frames(parts: RigParts) -> Iterator[Problem]:
    """Find names of images that the pairs' codes do not fit, or that are missing."""
    pairs = [pair for pair in parts.pairs if pair]
    codes = [(pair.name, pair.projector) for pair in pairs if pair.projector]
    frames = parts.frames
    if frames is None:
        return
    yield from _find_wrong_counts(frames, ("frames",), codes)
    across = [(name, code.crossing) for name, code in codes if code.crossing]
    yield from _find_wrong_counts(frames.crossing, ("frames", "crossing"), across)
    if frames.crossing.model_extra and not across and len(pairs) == len(parts.pairs):
        yield ("frames", "crossing"), "is for a projector with `crossing`: no pair has one"
    directions = [(name, one) for name, code in codes for one in code.directions]
    if frames.dark is None:
        lacking = next((name for name, one in directions if one.needs_dark), None)
        if lacking:
            wrong = f"is needed: pair {lacking} takes no inverses, so only it shows what black is"
            yield ("frames", "dark"), wrong
    if frames.lit is None:
        lacking = next((name for name, one in directions if one.needs_lit), None)
        if lacking:
            wrong = f"the images of pair {lacking} do not show the scene under full light"
            yield ("frames", "lit"), f"is needed: {wrong}"
        alone = next((pair.name for pair in pairs if not pair.projector), None)
        if alone and frames.board is None and "{frame}" in (parts.files or "{frame}"):
            wrong = f"or board is needed: pair {alone}, a camera alone, takes no other image"
            yield ("frames", "lit"), wrong


def _find_wrong_counts(
    names: ImageNames, where: tuple[str, ...], codes: Sequence[tuple[str, StripeCode]]
) -> Iterator[Problem]:
    """Find lists of names that are longer or shorter than a pair's code requires."""
    for kind in image_kinds():
        given = names.templates(kind)
        if isinstance(given, str):
            continue
        for pair, code in codes:
            count = code.image_counts.get(kind, len(given))
            if count != len(given):
                first = getattr(code, "first_code", 0)
                since = f" from {first}" if first else ""
                yield (
                    (*where, kind.name),
                    f"has {len(given)} names, but the {code.stripes} stripes of pair"
                    f" {pair}{since} take {count} {kind.number}s",
                )
                break


def _find_template_problems(parts: RigParts) -> Iterator[Problem]:
    """Find file-name templates, exposures and folders that do not fit."""
    many = len(parts.pairs) > 1
    stripes = any(pair and pair.projector for pair in parts.pairs)
    if len(parts.exposures) == 1:
        yield ("exposures",), "names one exposure: name two or more, the shortest first, or none"
    for index, name in find_duplicates(parts.exposures):
        yield ("exposures", index), f"is named twice (got {name!r})"
    templates = [(("files",), parts.files, stripes)] + [
        (("calibration", index, "files"), folder.files if folder else None, False)
        for index, folder in enumerate(parts.folders)
    ]
    for where, template, needs_frame in templates:
        if template is not None:
            faults = template_faults(
                template, many_pairs=many, needs_frame=needs_frame, exposures=bool(parts.exposures)
            )
            yield from ((where, fault) for fault in faults)
    paths = tuple(folder.folder.rstrip("/") if folder else None for folder in parts.folders)
    for index, path in find_duplicates(paths):
        yield ("calibration", index, "folder"), f"is listed twice (got {path!r})"


def _find_unknown_references(parts: RigParts) -> Iterator[Problem]:
    """Find names in `rig_frame` that the file does not have."""
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


def _find_wrong_references(parts: RigParts) -> Iterator[Problem]:
    """Find references to boards that cannot give a length."""
    names = tuple(reference.name if reference else None for reference in parts.references)
    for index, name in find_duplicates(names):
        yield ("references", index, "name"), f"is given to two references (got {name!r})"
    boards = {board.name: board for board in parts.boards if board}
    frame = parts.rig_frame
    for index, reference in enumerate(parts.references):
        if reference is None:
            continue
        where = ("references", index, "boards")
        if len(set(reference.boards)) < len(reference.boards):
            yield where, f"names a board twice (got {reference.boards[0]!r})"
        for k, name in enumerate(reference.boards):
            if name not in parts.board_names:
                hint = did_you_mean(name, filter(None, parts.board_names))
                yield (*where, k), f"names no board of this file{hint} (got {name!r})"
            elif name in boards and boards[name].kind == "checkerboard":
                yield (
                    (*where, k),
                    f"must have markers, which tell its corners apart from every side: board {name} "
                    "is a plain checkerboard",
                )
            elif frame and name == frame.board and len(parts.boards) > len(reference.boards):
                yield (
                    (*where, k),
                    f"must not fix the rig frame as well: board {name} of a reference takes no part "
                    "in placing the rig",
                )
