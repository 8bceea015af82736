"""A quick check of a rig file and its captures: nothing is decoded, nothing heavy imported."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any, TypeVar

from bodyscan.captures.folder import (
    IMAGE_SUFFIXES,
    Captures,
    ImageSequence,
    join_captures,
    open_folder,
    open_scan,
)
from bodyscan.captures.image_header import (
    NO_INVERSES,
    NotAnImage,
    describe_missing,
    find_header_fault,
    read_header,
)
from bodyscan.errors import BadInput, CaptureError
from bodyscan.rig.board import Board
from bodyscan.rig.pair import Pair
from bodyscan.rig.rig import Rig, find_unusual_lengths
from bodyscan.rig.rig_file import load_rig

Result = TypeVar("Result")


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

    pair: str
    pole: str | None
    stripe_shots: int
    lit_shots: int
    images: int


@dataclass(frozen=True)
class CheckReport:
    """What `check` found.

    errors: what must be corrected, besides images.
    warnings: what should be checked.
    bad_images: missing or unusable, by pair, then shot.
    images: how many were examined.
    """

    rig_path: Path
    rig: Rig
    folders: tuple[Path, ...]
    shots: tuple[str, ...]
    images: int
    pairs: tuple[PairCount, ...]
    bad_images: tuple[BadImage, ...]
    errors: tuple[str, ...]
    warnings: tuple[str, ...]

    @property
    def ok(self) -> bool:
        """Whether calibration can start."""
        return not (self.bad_images or self.errors)


def check(
    rig_path: Path, scans: Iterable[Path] = (), known_errors: Iterable[str] = ()
) -> CheckReport:
    """Check a rig file, the calibration captures it names, and scan folders if any are given.

    known_errors: what is wrong with the files that the rig file names as `known`.

    Raises RigFileError if the rig file is wrong: then nothing else can be checked.
    """
    rig = load_rig(rig_path)
    errors = list(known_errors)
    parts = [_attempt(errors, open_folder, rig, rig_path, entry) for entry in rig.calibration]
    opened = tuple(part for part in parts if part is not None)
    calibration = _attempt(errors, join_captures, opened) if opened else None
    scanned = [_attempt(errors, open_scan, rig, Path(scan)) for scan in scans]
    captures = [part for part in (calibration, *scanned) if part is not None]

    sequences = [sequence for part in captures for sequence in part.sequences]
    known = {path for part in captures for path in part.corners}
    found = zip(sequences, _map(partial(_find_bad_images, rig, known), sequences), strict=True)
    bad_of = dict(found)
    good = [s for s in (calibration.sequences if calibration else ()) if not bad_of[s]]
    counts = tuple(_count_shots(pair, good) for pair in rig.pairs)
    order = {pair.name: index for index, pair in enumerate(rig.pairs)}
    bad = sorted((bad for some in bad_of.values() for bad in some), key=lambda b: order[b.pair])
    for part in captures:
        taken = {sequence.shot for sequence in part.sequences}
        empty = [shot for shot in part.shots if shot not in taken]
        errors += [f"{part.folders[0]}: shot {shot}: no image" for shot in empty]
    if calibration:
        errors += _find_frame_errors(calibration, good)
        errors += _find_separate_groups(rig, good)
        errors += (
            () if rig.is_known else filter(None, map(_explain_too_few_shots, rig.pairs, counts))
        )
    return CheckReport(
        rig_path=Path(rig_path),
        rig=rig,
        folders=tuple(folder for part in captures for folder in part.folders),
        shots=calibration.shots if calibration else (),
        images=sum(len(sequence.paths) for sequence in sequences),
        pairs=counts,
        bad_images=tuple(bad),
        errors=tuple(errors),
        warnings=tuple(_find_warnings(Path(rig_path), rig, captures, calibration, counts)),
    )


def format_report(report: CheckReport) -> list[str]:
    """Format the report as lines of text, with bad images grouped by pair, shot and fault."""
    rig = report.rig
    counts = f"{_count(len(rig.pairs), 'pair')}, {_count(len(rig.boards), 'board')}"
    lines = [f"{report.rig_path}: rig {rig.name}: {counts}", *map(str, report.folders)]
    shots = _count(len(report.shots), "calibration shot")
    lines.append(f"{shots}, {_count(report.images, 'image')}")
    width = max(len(pair.pair) for pair in report.pairs)
    for count in report.pairs if report.folders else ():
        has_stripes = rig.pair(count.pair).projector
        stripes = f"{count.stripe_shots:4d} with stripes, " if has_stripes else ""
        lines.append(f"  {count.pair:{width}}  {stripes}{count.lit_shots:4d} lit only")
    lines += _format_bad_images(report.bad_images)
    lines += [f"error: {text}" for text in report.errors]
    lines += [f"warning: {text}" for text in report.warnings]
    faults = len(report.errors) + len(report.bad_images)
    lines.append("good" if report.ok else f"{_count(faults, 'fault')} to correct")
    return lines


def _map(work: Callable[[Any], Result], items: Iterable[Any]) -> list[Result]:
    """Map in threads, which wait for a disk or a server, not for a processor."""
    with ThreadPoolExecutor(8) as pool:
        return list(pool.map(work, items))


def _attempt(errors: list[str], work: Callable[..., Captures], *args: object) -> Captures | None:
    """Call `work`; if the captures cannot be opened, add the reason to `errors`."""
    try:
        return work(*args)
    except CaptureError as error:
        errors.append(str(error))
        return None


def _find_bad_images(rig: Rig, known: set[Path], sequence: ImageSequence) -> tuple[BadImage, ...]:
    """Find the unusable images of a sequence; none is needed if its corners are `known`."""
    camera, missing = rig.pair(sequence.pair).camera, set(sequence.missing)
    bad = []
    for path in sequence.paths:
        if path in known:
            continue
        if path in missing:
            fault: str | None = describe_missing(path)
        else:
            fault = find_header_fault(path, camera.width, camera.height)
        if fault:
            bad.append(BadImage(path, sequence.pair, sequence.shot, fault))
    return tuple(bad)


def _count_shots(pair: Pair, good: list[ImageSequence]) -> PairCount:
    taken = [sequence for sequence in good if sequence.pair == pair.name]
    stripes = sum(sequence.has_stripes for sequence in taken)
    images = sum(len(sequence.paths) for sequence in taken)
    return PairCount(pair.name, pair.pole, stripes, len(taken) - stripes, images)


def _count_poses(pair: Pair, count: PairCount) -> int:
    """Count the board poses that calibrate a pair."""
    return count.stripe_shots + (0 if pair.projector else count.lit_shots)


def _explain_too_few_shots(pair: Pair, count: PairCount) -> str | None:
    """The error if a pair has too few shots. It needs three board poses with stripes, a camera
    alone three lit ones (Zhang 2000)."""
    have = _count_poses(pair, count)
    if have >= 3:
        return None
    kind = "whole stripe sequence" if pair.projector else "lit image"
    return (
        f"pair {pair.name}: has {_count(have, kind)}; calibration needs 3 or more, "
        "with the board tilted differently in each"
    )


def _find_warnings(
    rig_path: Path,
    rig: Rig,
    captures: list[Captures],
    calibration: Captures | None,
    counts: tuple[PairCount, ...],
) -> Iterator[str]:
    """Find what should be checked, though calibration can start."""
    sequences = [sequence for part in captures for sequence in part.sequences]
    if not (rig.calibration or rig.is_known):
        yield f"{rig_path}: names no calibration captures"
    yield from find_unusual_lengths(rig)
    if calibration and rig.is_known and any(map(_explain_too_few_shots, rig.pairs, counts)):
        yield "all pairs are `known`: `bodyscan import` takes them as they are"
    if any(s.missing and set(s.missing) == set(s.inverses) for s in sequences):
        yield NO_INVERSES
    yield from _warn_of_jpeg(sequences)
    yield from filter(None, map(describe_unlisted_images, captures))
    if len(rig.pairs) > 1:  # a single camera cannot disagree
        yield from (_describe_symmetry(board) for board in rig.boards if board.is_ambiguous)
    if calibration and not rig.is_known:
        for pair, count in zip(rig.pairs, counts, strict=True):
            have = _count_poses(pair, count)
            if 3 <= have < 6:
                yield f"pair {pair.name}: {have} board poses will do, 6 or more are better"


def _warn_of_jpeg(sequences: list[ImageSequence]) -> Iterator[str]:
    """Warn of low-quality JPEG, judged by the first image of each pair.

    Boundaries and corners rise by some 40 grey levels per pixel, so four levels of rounding move
    them by 0.1 px, several times the effect of a camera's own noise.
    """
    firsts = {s.pair: path for s in reversed(sequences) for path in s.paths[:1]}
    errors = dict(zip(firsts, _map(_read_rounding_error, firsts.values()), strict=True))
    coarse = [pair for pair, grey in errors.items() if grey > 4.0]
    if coarse:
        yield (
            f"images of {', '.join(sorted(coarse))} are JPEG of low quality: they err by up to "
            f"{max(errors.values()):.0f} grey levels, and stripes' boundaries with them; save PNG, "
            "or JPEG of a quality of 95 or more"
        )


def _read_rounding_error(path: Path) -> float:
    """Read a JPEG's error in grey levels; 0 if it cannot be read, which is reported elsewhere."""
    try:
        return read_header(path).rounding_error
    except (NotAnImage, BadInput, OSError):
        return 0.0


def _describe_symmetry(board: Board) -> str:
    count = f"{board.columns} x {board.rows} squares"
    why = "its two faces are equal" if board.faces == 2 else f"it has {count}, an even sum"
    return (
        f"board {board.name} looks the same rotated by 180 degrees ({why}): cameras may number its "
        "corners from different ends; better is an odd number of columns with an even one of rows, "
        "or ChArUco"
    )


def _find_separate_groups(rig: Rig, good: list[ImageSequence]) -> list[str]:
    """The error if there are groups of pairs without a common shot: nothing can join them."""
    groups: list[tuple[set[str], set[str]]] = []  # pairs and their shots
    for pair in rig.pairs:
        pairs, shots = {pair.name}, {s.shot for s in good if s.pair == pair.name}
        if not shots:
            continue
        connected = [group for group in groups if group[1] & shots]
        for group in connected:
            groups.remove(group)
            pairs, shots = pairs | group[0], shots | group[1]
        groups.append((pairs, shots))
    if len(groups) < 2:
        return []
    named = " | ".join(", ".join(sorted(pairs)) for pairs, _ in groups)
    return [
        f"these groups of pairs have no shot in common, so that nothing joins them: {named}; take "
        "shots in which cameras of both see a board"
    ]


def _find_frame_errors(calibration: Captures, good: list[ImageSequence]) -> list[str]:
    """The error if the shot that fixes the rig frame is missing or unusable."""
    frame = calibration.rig.rig_frame
    if missing := frame.missing_shot(calibration.shots):
        return [missing]
    if frame.shot is None or any(sequence.shot == frame.shot for sequence in good):
        return []
    return [f"rig_frame.shot: no pair has its images of '{frame.shot}', which fixes the rig frame"]


def _format_bad_images(bad: tuple[BadImage, ...]) -> list[str]:
    """Format one line per pair, shot and fault, with the first file of each; one per pair and fault if
    more than three shots have it."""
    shots_of: dict[tuple[str, str], set[str]] = {}
    for image in bad:
        shots_of.setdefault((image.pair, image.what), set()).add(image.shot)

    def key(image: BadImage) -> tuple[str, str, str]:
        shots = shots_of[image.pair, image.what]
        where = f"{len(shots)} shots" if len(shots) > 3 else f"shot {image.shot}"
        return image.pair, where, image.what

    lines = []
    for (pair, where, what), group in groupby(sorted(bad, key=key), key=key):
        files = [image.path for image in group]
        rest = f" (and {len(files) - 1} more)" if len(files) > 1 else ""
        lines.append(f"error: pair {pair}, {where}: {files[0]}: {what}{rest}")
    return lines


def _count(count: int, noun: str) -> str:
    return f"{count} {noun}{'' if count == 1 else 's'}"


def describe_unlisted_images(captures: Captures) -> str | None:
    """Describe images that the rig file does not name, often in a renamed folder; None if none."""
    found = _find_unlisted_images(captures)
    if not found:
        return None
    number = "1 image belongs" if len(found) == 1 else f"{len(found)} images belong"
    return (
        f"{number} to no pair and frame of the rig file, such as {found[0]}: check the spelling of "
        "its names"
    )


def _find_unlisted_images(captures: Captures) -> list[Path]:
    """Find images next to those of the shots that belong to no pair and frame of the rig file.

    Shots that are not wanted are ignored, unless nothing is left of one that is: it may have been
    renamed.
    """
    complete = {s.shot for s in captures.sequences if len(s.missing) < len(s.paths)}
    renamed = any(shot not in complete for shot in captures.shots)
    wanted = {path for sequence in captures.sequences for path in sequence.paths}
    folders = {path.parent.parent for path in wanted} | {path.parent for path in wanted}
    named = {(len(path.parts), path.stem) for path in wanted}
    suffixes = {path.suffix for path in wanted}
    unlisted = []
    for folder in captures.folders:
        for root, _, names in os.walk(folder):
            for path in (Path(root, name) for name in names):
                if path.suffix.lower() not in IMAGE_SUFFIXES or path in wanted:
                    continue
                of_shot = set(path.relative_to(folder).parts[:-1]) & set(captures.shots)
                # of another shot whose name differs only in its suffix
                other = path.suffix not in suffixes and (len(path.parts), path.stem) in named
                if renamed or of_shot or path.parent in folders or other:
                    unlisted.append(path)
    return sorted(unlisted)
