"""A quick check of a rig file and its captures: nothing is decoded, nothing heavy imported."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from bodyscan.captures.folder import (
    IMAGE_SUFFIXES,
    Captures,
    ImageSequence,
    join_captures,
    open_folder,
)
from bodyscan.captures.image_header import (
    NO_INVERSES,
    NotAnImage,
    describe_missing,
    find_header_fault,
    read_header,
)
from bodyscan.errors import BadInput, CaptureError
from bodyscan.files.messages import describe_similar_shots
from bodyscan.progress import map_threads
from bodyscan.rig.pair import Pair
from bodyscan.rig.rig import Rig, find_connected_groups, find_unusual_lengths, load_rig

WORKERS = 8  # threads, which wait for a disk or a server, not for a processor


@dataclass(frozen=True)
class BadImage:
    """An image that is missing or unusable, and why."""

    path: Path
    pair: str
    shot: str
    what: str


@dataclass(frozen=True)
class PairCount:
    """How many shots of the calibration captures a pair took part in, if all images are good."""

    pair: Pair
    stripe_shots: int
    lit_shots: int

    @property
    def poses(self) -> int:
        """Number of board poses that calibrate the pair."""
        return self.stripe_shots + (0 if self.pair.projector else self.lit_shots)

    def explain_too_few(self) -> str | None:
        """The error if there are too few: Zhang (2000) needs three poses."""
        if self.poses >= 3:
            return None
        kind = "whole stripe sequence" if self.pair.projector else "lit image"
        return (
            f"pair {self.pair.name}: has {_format_count(self.poses, kind)}; calibration needs 3 or "
            "more, with the board tilted differently in each"
        )


@dataclass(frozen=True)
class CheckReport:
    """What `check` found."""

    rig_path: Path
    rig: Rig
    folders: tuple[Path, ...]
    shots: tuple[str, ...]
    images: int  # how many were examined
    pairs: tuple[PairCount, ...]
    bad_images: tuple[BadImage, ...]  # missing or unusable, by pair, then shot
    errors: tuple[str, ...]  # what must be corrected, besides images
    warnings: tuple[str, ...]  # what should be checked

    @property
    def ok(self) -> bool:
        """Whether calibration can start."""
        return not (self.bad_images or self.errors)


def check(rig_path: Path, known_errors: Iterable[str] = ()) -> CheckReport:
    """Check a rig file and the calibration captures it names.

    known_errors: what is wrong with the files that the rig file names as `known`.

    Raises RigFileError if the rig file is wrong: then nothing else can be checked.
    """
    rig, errors = load_rig(rig_path), list(known_errors)
    opened: list[Captures] = []
    captures = None
    for entry in rig.calibration:
        try:
            opened.append(open_folder(rig, rig_path, entry))
        except CaptureError as error:
            errors.append(str(error))
    try:
        captures = join_captures(tuple(opened)) if opened else None
    except CaptureError as error:
        errors.append(str(error))
    sequences = captures.sequences if captures else ()
    find_bad = partial(_find_bad_images, rig, set(captures.corners if captures else ()))
    found = map_threads(find_bad, sequences, workers=WORKERS)
    good = [sequence for sequence, bad in zip(sequences, found, strict=True) if not bad]
    striped = {p.name: [s.has_stripes for s in good if s.pair == p.name] for p in rig.pairs}
    counts = tuple(
        PairCount(pair, sum(striped[pair.name]), striped[pair.name].count(False))
        for pair in rig.pairs
    )
    order = {pair.name: index for index, pair in enumerate(rig.pairs)}
    if captures:
        taken = {sequence.shot for sequence in sequences}
        empty = [shot for shot in captures.shots if shot not in taken]
        errors += [f"{captures.folders[0]}: shot {shot}: no image" for shot in empty]
        errors += _find_frame_errors(captures, good)
        errors += _find_separate_groups(good)
        if not rig.is_known:
            errors += filter(None, (count.explain_too_few() for count in counts))
    return CheckReport(
        rig_path=Path(rig_path),
        rig=rig,
        folders=captures.folders if captures else (),
        shots=captures.shots if captures else (),
        images=sum(len(sequence.paths) for sequence in sequences),
        pairs=counts,
        bad_images=tuple(sorted((b for bad in found for b in bad), key=lambda b: order[b.pair])),
        errors=tuple(errors),
        warnings=tuple(_find_warnings(Path(rig_path), rig, captures, counts)),
    )


def format_report(report: CheckReport) -> list[str]:
    """Format the report as lines of text, with bad images grouped by pair and fault."""
    rig = report.rig
    counts = f"{_format_count(len(rig.pairs), 'pair')}, {_format_count(len(rig.boards), 'board')}"
    lines = [f"{report.rig_path}: rig {rig.name}: {counts}", *map(str, report.folders)]
    for board in rig.boards:
        squares = f"{board.columns} x {board.rows} squares of {board.square_mm:g} mm"
        size = "{:g} x {:g} mm".format(*board.size_mm)
        lines.append(f"board {board.name}: {squares}, {size} in all: every length rests on it")
    shots = _format_count(len(report.shots), "calibration shot")
    lines.append(f"{shots}, {_format_count(report.images, 'image')}")
    width = max(len(pair.name) for pair in rig.pairs)
    for count in report.pairs if report.folders else ():
        stripes = f"{count.stripe_shots:4d} with stripes, " if count.pair.projector else ""
        lines.append(f"  {count.pair.name:{width}}  {stripes}{count.lit_shots:4d} lit only")
    lines += _format_bad_images(report.bad_images)
    lines += [f"error: {text}" for text in report.errors]
    lines += [f"warning: {text}" for text in report.warnings]
    faults = len(report.errors) + len(report.bad_images)
    lines.append("good" if report.ok else f"{_format_count(faults, 'fault')} to correct")
    return lines


def _find_bad_images(rig: Rig, known: set[Path], sequence: ImageSequence) -> list[BadImage]:
    """Find the unusable images of a sequence; none is needed if its corners are `known`."""
    camera, missing = rig.pair(sequence.pair).camera, set(sequence.missing)
    faults = {
        path: describe_missing(path)
        if path in missing
        else find_header_fault(path, camera.width, camera.height)
        for path in sequence.paths
        if path not in known
    }
    return [
        BadImage(path, sequence.pair, sequence.shot, what) for path, what in faults.items() if what
    ]


def _find_warnings(
    rig_path: Path, rig: Rig, captures: Captures | None, counts: tuple[PairCount, ...]
) -> Iterator[str]:
    """Find what should be checked, though calibration can start."""
    if not (rig.calibration or rig.is_known):
        yield f"{rig_path}: names no calibration captures"
    yield from find_unusual_lengths(rig)
    if captures and rig.is_known and any(count.explain_too_few() for count in counts):
        yield "all pairs are `known`: `bodyscan import` takes them as they are"
    sequences = captures.sequences if captures else ()
    if any(s.missing and set(s.missing) == set(s.inverses) for s in sequences):
        yield NO_INVERSES
    yield from _warn_of_jpeg(sequences)
    yield from filter(None, [captures and describe_unlisted_images(captures)])
    if len(rig.pairs) > 1:  # a single camera cannot disagree
        for board in [board for board in rig.boards if board.is_ambiguous]:
            sides = f"it has {board.columns} x {board.rows} squares, an even sum"
            why = "its two faces are equal" if board.faces == 2 else sides
            yield (
                f"board {board.name} looks the same rotated by 180 degrees ({why}): cameras may "
                "number its corners from different ends; prefer an odd number of columns and an even "
                "number of rows, or ChArUco"
            )
    for count in counts if captures and not rig.is_known else ():
        if 3 <= count.poses < 6:
            yield f"pair {count.pair.name}: {count.poses} board poses will do, 6 or more are better"


def _warn_of_jpeg(sequences: Iterable[ImageSequence]) -> Iterator[str]:
    """Warn of low-quality JPEG, judged by the first image of each pair. Boundaries and corners rise by
    some 40 grey levels per pixel, so four levels of rounding move them by 0.1 px, several times the
    effect of a camera's own noise."""
    firsts = {s.pair: path for s in reversed(tuple(sequences)) for path in s.paths[:1]}
    errors = {}
    for pair, path in firsts.items():
        with suppress(NotAnImage, BadInput, OSError):  # reported elsewhere
            errors[pair] = read_header(path).rounding_error
    coarse = [pair for pair, grey in errors.items() if grey > 4.0]
    if coarse:
        yield (
            f"images of {', '.join(sorted(coarse))} are JPEG of low quality: they err by up to "
            f"{max(errors.values()):.0f} grey levels, which shifts stripe boundaries; save PNG, "
            "or JPEG of a quality of 95 or more"
        )


def _find_separate_groups(good: list[ImageSequence]) -> list[str]:
    """The error if there are groups of pairs without a common shot: nothing can join them."""
    one_of = {sequence.shot: sequence.pair for sequence in good}
    edges = [(one_of[sequence.shot], sequence.pair) for sequence in good]
    groups = find_connected_groups((pair for _, pair in edges), edges)
    if len(groups) < 2:
        return []
    named = " | ".join(sorted(", ".join(sorted(group)) for group in groups))
    similar = describe_similar_shots((sequence.pair, sequence.shot) for sequence in good)
    return [
        f"these groups of pairs have no shot in common, so that nothing joins them: {named}; "
        + (similar or "take shots in which cameras of both see a board")
    ]


def _find_frame_errors(captures: Captures, good: list[ImageSequence]) -> list[str]:
    """The error if the shot that fixes the rig frame is missing or unusable."""
    frame = captures.rig.rig_frame
    if missing := frame.missing_shot(captures.shots):
        return [missing]
    if frame.shot is None or any(sequence.shot == frame.shot for sequence in good):
        return []
    return [f"rig_frame.shot: no pair has its images of '{frame.shot}', which fixes the rig frame"]


def _format_bad_images(bad: tuple[BadImage, ...]) -> list[str]:
    """Format one line per pair and fault, with its shots and the first file."""
    found: dict[tuple[str, str], list[BadImage]] = {}
    for image in bad:
        found.setdefault((image.pair, image.what), []).append(image)
    lines = []
    for (pair, what), images in found.items():
        shots = list(dict.fromkeys(image.shot for image in images))
        where = f"{len(shots)} shots" if len(shots) > 3 else f"shot {', '.join(shots)}"
        rest = f" (and {len(images) - 1} more)" if len(images) > 1 else ""
        lines.append(f"error: pair {pair}, {where}: {images[0].path}: {what}{rest}")
    return lines


def _format_count(count: int, noun: str) -> str:
    return f"{count} {noun}{'' if count == 1 else 's'}"


def describe_unlisted_images(captures: Captures) -> str | None:
    """Describe images next to those of the shots that the rig file does not name, often in a renamed
    folder; None if there are none.

    Shots that are not wanted are ignored, unless nothing is left of one that is, perhaps renamed.
    """
    complete = {s.shot for s in captures.sequences if len(s.missing) < len(s.paths)}
    renamed = any(shot not in complete for shot in captures.shots)
    wanted = {path for sequence in captures.sequences for path in sequence.paths}
    folders = {path.parent.parent for path in wanted} | {path.parent for path in wanted}
    named = {(len(path.parts), path.stem) for path in wanted}
    suffixes = {path.suffix for path in wanted}
    patterns = {
        re.escape(str(path)).replace(re.escape(sequence.shot), ".+")
        for sequence in captures.sequences
        for path in sequence.paths
    }
    listed = any(entry.shots for entry in captures.rig.calibration) and not renamed
    unwanted = re.compile("|".join(sorted(patterns)) if listed else "(?!)")
    found = []
    for folder in captures.folders:
        for path in (Path(root, name) for root, _, names in os.walk(folder) for name in names):
            if path.suffix.lower() not in IMAGE_SUFFIXES or path in wanted:
                continue
            if unwanted.fullmatch(str(path)):
                continue
            of_shot = set(path.relative_to(folder).parts[:-1]) & set(captures.shots)
            # of another shot whose name differs only in its suffix
            other = path.suffix not in suffixes and (len(path.parts), path.stem) in named
            if renamed or of_shot or path.parent in folders or other:
                found.append(path)
    if not found:
        return None
    number = "1 image belongs" if len(found) == 1 else f"{len(found)} images belong"
    return (
        f"{number} to no pair and frame of the rig file, such as {min(found)}: check the spelling of "
        "its names"
    )
