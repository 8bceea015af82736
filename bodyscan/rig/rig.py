"""The rig file: boards, poles, pairs, where captures lie and how files are named; docs/formats.md."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Literal, TypeVar

from pydantic import Field, PositiveFloat

from bodyscan.errors import RigFileError
from bodyscan.files.atomic import write_text
from bodyscan.files.model import Model, Name, Problem, did_you_mean, find_duplicates
from bodyscan.files.model_file import load_model
from bodyscan.files.yaml_file import dump_yaml
from bodyscan.rig.board import Board, find_dictionary_family
from bodyscan.rig.devices import CapturePlan
from bodyscan.rig.frame_names import CaptureFolder, FrameNames, ImageNames
from bodyscan.rig.gauge import Reference, RigFrame
from bodyscan.rig.pair import Pair
from bodyscan.rig.templates import find_template_faults
from bodyscan.stripes.codes import list_image_kinds
from bodyscan.stripes.stripe_code import StripeCode

Node = TypeVar("Node", int, str)


class Volume(Model):
    """The scan volume: an upright cylinder on the floor around the rig's centre."""

    radius_mm: PositiveFloat = 700.0
    bottom_mm: float = 5.0
    top_mm: PositiveFloat = 2200.0

    def problems(self) -> Iterator[Problem]:
        if self.bottom_mm >= self.top_mm:
            wrong = f"must lie below top_mm ({self.top_mm:g}) (got {self.bottom_mm:g})"
            yield ("bottom_mm",), wrong


ExposureName = Annotated[str, Field(pattern=r"^[\w.+-]+$", max_length=64)]


class Rig(Model):
    """The whole rig file.

    exposures: what `{exposure}` in file names becomes, the shortest first; () for a single one.
    follow_links: whether symbolic links may lead out of a capture folder.
    references: certified lengths that fix the size.
    capture: the devices that take its images; None if another program does.
    """

    version: Literal[1] = 1
    name: Name
    boards: tuple[Board, ...] = ()
    pairs: tuple[Pair, ...] = Field(min_length=1)
    calibration: tuple[CaptureFolder, ...] = ()
    references: tuple[Reference, ...] = ()
    files: str = "{shot}/{pair}/{frame}.png"
    exposures: tuple[ExposureName, ...] = ()
    follow_links: bool = False
    frames: FrameNames = FrameNames()
    rig_frame: RigFrame = RigFrame()
    volume: Volume = Volume()
    capture: CapturePlan | None = None

    def pair(self, name: str) -> Pair:
        """Return the pair of that name. Raises KeyError if there is none."""
        return {pair.name: pair for pair in self.pairs}[name]

    def board(self, name: str) -> Board:
        """Return the board of that name. Raises KeyError if there is none."""
        return {board.name: board for board in self.boards}[name]

    @property
    def is_known(self) -> bool:
        """Whether another program calibrated all of it, including the projectors."""
        return all(one.known and (one.known.projector or not one.projector) for one in self.pairs)

    @property
    def poles(self) -> dict[str, str]:
        """The pole of each pair that is on one."""
        return {pair.name: pair.pole for pair in self.pairs if pair.pole}

    @property
    def frame_pair(self) -> Pair | None:
        """The pair that fixes the rig frame, or None if a board in a shot does."""
        if self.rig_frame.shot is not None:
            return None
        return self.pair(self.rig_frame.pair) if self.rig_frame.pair else self.pairs[0]

    @property
    def frame_board(self) -> Board | None:
        """The board that fixes the rig frame, or None if a pair does."""
        if self.rig_frame.shot is None:
            return None
        return self.board(self.rig_frame.board) if self.rig_frame.board else self.boards[0]

    def problems(self) -> Iterator[Problem]:
        """What does not fit together in a rig whose parts are valid by themselves."""
        yield from _find_repeated_names(self)
        if self.calibration and not self.boards:
            yield ("boards",), "is missing: calibration captures show a board"
        yield from _find_marker_overlaps(self.boards)
        yield from _find_wrong_frames(self)
        yield from _find_template_problems(self)
        yield from _find_rig_frame_problems(self)
        yield from _find_wrong_references(self)
        names = [pair.name for pair in self.pairs]
        for name in self.capture.pairs if self.capture else ():
            if name not in names:
                wrong = f"names no pair of this file{did_you_mean(name, names)}"
                yield ("capture", "pairs", name), wrong


def load_rig(path: Path) -> Rig:
    """Read and check a rig file.

    Raises RigFileError, which lists every problem of its parts by line; once these are valid, every
    way in which they do not fit together.
    """
    remedy = "Correct the rig file; docs/formats.md explains every key."
    return load_model(Path(path), Rig, RigFileError, remedy=remedy)


def write_rig(path: Path, rig: Rig) -> None:
    """Write a rig file that `load_rig` reads back as the same rig (comments are not kept)."""
    data = rig.model_dump(mode="json", exclude_defaults=True)
    write_text(path, dump_yaml({"version": rig.version, **data}))


def find_unusual_lengths(rig: Rig) -> Iterator[str]:
    """Warn of lengths that a body scanner is unlikely to have, such as metres instead of mm."""
    lengths = [(f"board {one.name}: square_mm", one.square_mm, 8.0, 500.0) for one in rig.boards]
    lengths += [
        ("volume: radius_mm", rig.volume.radius_mm, 50.0, 5000.0),
        ("volume: its height", rig.volume.top_mm - rig.volume.bottom_mm, 50.0, 5000.0),
    ]
    for pair in rig.pairs:
        if pair.nominal is not None:
            distance = math.dist(pair.nominal.position_mm, pair.nominal.look_at_mm)
            what = f"pair {pair.name}: nominal, from what it looks at"
            lengths.append((what, distance, 50.0, 20_000.0))
    for what, value, low, high in lengths:
        if not low <= value <= high:
            yield (
                f"{what} is {value:g} mm, but {low:g} to {high:g} mm is usual: check that it is in "
                "mm, as all lengths of a rig file are"
            )


def _find_repeated_names(rig: Rig) -> Iterator[Problem]:
    for key in ("boards", "pairs", "references"):
        for index, name in find_duplicates([part.name for part in getattr(rig, key)]):
            yield (key, index, "name"), f"is given to two {key}: every name once (got {name!r})"
    for index, name in find_duplicates(rig.exposures):
        yield ("exposures", index), f"is named twice (got {name!r})"
    folders = [f"{one.folder.rstrip('/')} {one.files or ''}".strip() for one in rig.calibration]
    for index, path in find_duplicates(folders):
        yield ("calibration", index, "folder"), f"is listed twice (got {path!r})"


def _find_marker_overlaps(boards: Sequence[Board]) -> Iterator[Problem]:
    taken: list[tuple[Board, range]] = []
    for index, board in enumerate(boards):
        ids = range(board.first_marker, board.first_marker + board.marker_count)
        for other, theirs in taken:
            shared = range(max(ids.start, theirs.start), min(ids.stop, theirs.stop))
            family, its = (
                find_dictionary_family(other.dictionary),
                find_dictionary_family(board.dictionary),
            )
            if shared and family == its:
                yield (
                    ("boards", index, "first_marker"),
                    f"gives board {board.name} markers {ids.start} to {ids.stop - 1}, of which"
                    f" board {other.name} has {shared.start} to {shared.stop - 1} as well:"
                    f" print it with first_marker {theirs.stop} or more",
                )
        taken.append((board, ids))


def _find_wrong_frames(rig: Rig) -> Iterator[Problem]:
    """Find names of images that the pairs' codes do not fit, or that are missing."""
    frames = rig.frames
    codes = [(pair.name, pair.projector) for pair in rig.pairs if pair.projector]
    yield from _find_wrong_counts(frames, ("frames",), codes)
    across = [(name, code.crossing) for name, code in codes if code.crossing]
    yield from _find_wrong_counts(frames.crossing, ("frames", "crossing"), across)
    if frames.crossing.model_extra and not across:
        yield ("frames", "crossing"), "is for a projector with `crossing`: no pair has one"
    directions = [(name, one) for name, code in codes for one in code.directions]
    if frames.dark is None:
        for lacking in [name for name, one in directions if one.needs_dark][:1]:
            wrong = f"is needed: pair {lacking} takes no inverses, so only it shows what black is"
            yield ("frames", "dark"), wrong
    if frames.lit is None:
        for lacking in [name for name, one in directions if one.needs_lit][:1]:
            wrong = f"the images of pair {lacking} do not show the scene under full light"
            yield ("frames", "lit"), f"is needed: {wrong}"
        alone = [pair.name for pair in rig.pairs if not pair.projector]
        if alone and frames.board is None and "{frame}" in rig.files:
            wrong = f"or board is needed: pair {alone[0]}, a camera alone, takes no other image"
            yield ("frames", "lit"), wrong


def _find_wrong_counts(
    names: ImageNames, where: tuple[str, ...], codes: Sequence[tuple[str, StripeCode]]
) -> Iterator[Problem]:
    """Find lists of names that are longer or shorter than a pair's code requires."""
    for kind in list_image_kinds():
        given = names.templates(kind)
        for pair, code in codes if not isinstance(given, str) else ():
            count = code.image_counts.get(kind, len(given))
            if count != len(given):
                first = getattr(code, "first_code", 0)
                of = f"{code.stripes} stripes of pair {pair}{f' from {first}' if first else ''}"
                wrong = f"has {len(given)} names, but the {of} take {count} {kind.number}s"
                yield (*where, kind.name), wrong
                break


def _find_template_problems(rig: Rig) -> Iterator[Problem]:
    """Find file-name templates that do not fit the pairs and exposures."""
    many, stripes = len(rig.pairs) > 1, any(pair.projector for pair in rig.pairs)
    if len(rig.exposures) == 1:
        yield ("exposures",), "names one exposure: name two or more, the shortest first, or none"
    templates: list[tuple[tuple[str | int, ...], str, bool]] = [(("files",), rig.files, stripes)]
    for index, folder in enumerate(rig.calibration):
        if folder.files:
            templates.append((("calibration", index, "files"), folder.files, False))
    for where, template, needs_frame in templates:
        for fault in find_template_faults(template, many, needs_frame, bool(rig.exposures)):
            yield where, fault


def _find_rig_frame_problems(rig: Rig) -> Iterator[Problem]:
    frame = rig.rig_frame
    for key, parts in (("pair", rig.pairs), ("board", rig.boards)):
        wanted, names = getattr(frame, key), [part.name for part in parts]
        if wanted is not None and wanted not in names:
            hint = did_you_mean(wanted, names)
            yield ("rig_frame", key), f"names no {key} of this file{hint} (got {wanted!r})"
    if frame.shot is not None and frame.board is None and len(rig.boards) > 1:
        yield ("rig_frame", "board"), "is missing: say which of the boards fixes the rig frame"


def _find_wrong_references(rig: Rig) -> Iterator[Problem]:
    """Find references to boards that cannot give a length."""
    boards = {board.name: board for board in rig.boards}
    for index, reference in enumerate(rig.references):
        where = ("references", index, "boards")
        if len(set(reference.boards)) < len(reference.boards):
            yield where, f"names a board twice (got {reference.boards[0]!r})"
        for k, name in enumerate(reference.boards):
            wrong = ""
            if name not in boards:
                wrong = f"names no board of this file{did_you_mean(name, boards)} (got {name!r})"
            elif boards[name].kind == "checkerboard":
                wrong = "must have markers, which tell its corners apart from every side: board "
                wrong += f"{name} is a plain checkerboard"
            elif name == rig.rig_frame.board and len(rig.boards) > len(reference.boards):
                wrong = f"must not fix the rig frame as well: board {name} of a reference takes no "
                wrong += "part in placing the rig"
            if wrong:
                yield (*where, k), wrong


def find_connected_groups(
    names: Iterable[Node], edges: Iterable[tuple[Node, Node]]
) -> list[set[Node]]:
    """Connected components of a graph, such as of pairs that share shots, in the order of `names`."""
    groups = {name: {name} for name in names}
    for one, other in edges:
        joined = groups[one] | groups[other]
        groups |= dict.fromkeys(joined, joined)
    return list({id(group): group for group in groups.values()}.values())
