"""A quick check of a rig file and its captures: nothing is decoded, nothing heavy imported."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

from bodyscan.captures.folder import Captures, ImageSequence, join_captures, open_folder, open_scan
from bodyscan.captures.image_faults import NO_INVERSES, absence, header_fault
from bodyscan.captures.image_header import NoImage, read_header
from bodyscan.captures.unlisted_images import describe_unlisted_images
from bodyscan.errors import BadInput, CaptureError
from bodyscan.rig.board import Board
from bodyscan.rig.pair import Pair
from bodyscan.rig.rig import Rig
from bodyscan.rig.rig_file import load_rig
from bodyscan.rig.sizes import odd_sizes

FEWEST_SHOTS = 3
ENOUGH_SHOTS = 6
MANY_SHOTS = 3
"""If more shots than this have the same fault, they share a line."""
COARSE = 4.0
"""Grey levels of rounding. Boundaries and corners rise by some 40 per pixel, so this moves them by
0.1 px, several times the effect of a camera's own noise."""
_READERS = 8  # threads that wait for a disk or a server, not for a processor


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

    errors: what must be mended, besides images.
    warnings: what should be looked at.
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
    with ThreadPoolExecutor(_READERS) as pool:
        bad_of = dict(pool.map(lambda s: (s, _bad_images(rig, s, known)), sequences))
    good = [s for s in (calibration.sequences if calibration else ()) if not bad_of[s]]
    counts = tuple(_count(pair, good) for pair in rig.pairs)
    place = {pair.name: index for index, pair in enumerate(rig.pairs)}
    bad = sorted((bad for found in bad_of.values() for bad in found), key=lambda b: place[b.pair])
    for part in captures:
        errors += [f"{part.folders[0]}: shot {shot}: no image" for shot in _empty_shots(part)]
    if calibration:
        errors += _frame_errors(calibration, good)
        errors += _untied(rig, good)
        too_few = [*filter(None, map(_too_few, rig.pairs, counts))]
        errors += () if rig.is_known else too_few
    silent = rig.calibration or rig.is_known
    warnings = [] if silent else [f"{rig_path}: names no calibration captures"]
    warnings += odd_sizes(rig)
    if calibration and rig.is_known and too_few:
        warnings += ["all pairs are `known`: `bodyscan import` takes them as they are"]
    warnings += [NO_INVERSES] if any(map(_lacks_inverses, sequences)) else []
    warnings += _coarse_images(sequences)
    warnings += filter(None, map(describe_unlisted_images, captures))
    if len(rig.pairs) > 1:  # a single camera cannot disagree
        warnings += [_turned(board) for board in rig.boards if board.looks_same_turned]
    warnings += (
        filter(None, map(_few, rig.pairs, counts)) if calibration and not rig.is_known else ()
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
        warnings=tuple(warnings),
    )


def report_lines(report: CheckReport) -> list[str]:
    """The report as lines of text, with bad images grouped by pair, shot and fault."""
    rig = report.rig
    lines = [
        f"{report.rig_path}: rig {rig.name}: {_several(len(rig.pairs), 'pair')},"
        f" {_several(len(rig.boards), 'board')}"
    ]
    shots = _several(len(report.shots), "calibration shot")
    lines += [f"{folder}" for folder in report.folders]
    lines.append(f"{shots}, {_several(report.images, 'image')}")
    width = max(len(pair.pair) for pair in report.pairs)
    for count in report.pairs if report.folders else ():
        stripes = (
            f"{count.stripe_shots:4d} with stripes, " if rig.pair(count.pair).projector else ""
        )
        lines.append(f"  {count.pair:{width}}  {stripes}{count.lit_shots:4d} lit only")
    lines += _bad_lines(report.bad_images)
    lines += [f"error: {text}" for text in report.errors]
    lines += [f"warning: {text}" for text in report.warnings]
    faults = len(report.errors) + len(report.bad_images)
    lines.append("good" if report.ok else f"{_several(faults, 'fault')} to correct")
    return lines


def _attempt(errors: list[str], work: Callable[..., Captures], *args: object) -> Captures | None:
    """Call `work`; if the captures cannot be opened, add the reason to `errors`."""
    try:
        return work(*args)
    except CaptureError as error:
        errors.append(str(error))
        return None


def _bad_images(rig: Rig, sequence: ImageSequence, known: set[Path]) -> tuple[BadImage, ...]:
    """The unusable images of a sequence; none is needed if its corners are `known`."""
    camera = rig.pair(sequence.pair).camera
    missing = set(sequence.missing)
    faults = (
        (
            path,
            absence(path) if path in missing else header_fault(path, camera.width, camera.height),
        )
        for path in sequence.paths
        if path not in known
    )
    return tuple(
        BadImage(path, sequence.pair, sequence.shot, fault) for path, fault in faults if fault
    )


def _count(pair: Pair, good: list[ImageSequence]) -> PairCount:
    own = [sequence for sequence in good if sequence.pair == pair.name]
    stripes = sum(sequence.has_stripes for sequence in own)
    images = sum(len(sequence.paths) for sequence in own)
    return PairCount(pair.name, pair.pole, stripes, len(own) - stripes, images)


def _too_few(pair: Pair, count: PairCount) -> str | None:
    """Why a pair has too few shots, or None. It needs three board poses with stripes, a camera
    alone three lit ones (Zhang 2000)."""
    have = count.stripe_shots + (0 if pair.projector else count.lit_shots)
    if have >= FEWEST_SHOTS:
        return None
    kind = "whole stripe sequence" if pair.projector else "lit image"
    return (
        f"pair {pair.name}: has {_several(have, kind)}; calibration needs {FEWEST_SHOTS} or more,"
        " with the board tilted differently in each"
    )


def _few(pair: Pair, count: PairCount) -> str | None:
    """A warning if there are enough shots to calibrate but
    hardly enough to trust the result, or None."""
    have = count.stripe_shots + (0 if pair.projector else count.lit_shots)
    if not FEWEST_SHOTS <= have < ENOUGH_SHOTS:
        return None
    return f"pair {pair.name}: {have} board poses will do, {ENOUGH_SHOTS} or more are better"


def _lacks_inverses(sequence: ImageSequence) -> bool:
    """Whether all inverses are missing, and nothing else."""
    return bool(sequence.missing) and set(sequence.missing) == set(sequence.inverses)


def _empty_shots(captures: Captures) -> list[str]:
    taken = {sequence.shot for sequence in captures.sequences}
    return [shot for shot in captures.shots if shot not in taken]


def _coarse_images(sequences: list[ImageSequence]) -> list[str]:
    """Warn of low-quality JPEG, judged by the first image of each pair."""
    firsts = {s.pair: path for s in reversed(sequences) for path in s.paths[:1]}
    with ThreadPoolExecutor(_READERS) as pool:
        rounded = dict(zip(firsts, pool.map(_rounding, firsts.values()), strict=True))
    coarse = [pair for pair, grey in rounded.items() if grey > COARSE]
    if not coarse:
        return []
    return [
        f"images of {', '.join(sorted(coarse))} are JPEG of low quality: they err by up to "
        f"{max(rounded.values()):.0f} grey levels, and stripes' boundaries with them; save PNG, or "
        "JPEG of a quality of 95 or more"
    ]


def _rounding(path: Path) -> float:
    """Rounding in grey levels; 0 if the file cannot be read, which is reported elsewhere."""
    try:
        return read_header(path).rounded
    except (NoImage, BadInput, OSError):
        return 0.0


def _turned(board: Board) -> str:
    count = f"{board.columns} x {board.rows} squares"
    why = "its two faces are alike" if board.faces == 2 else f"it has {count}, an even sum"
    return (
        f"board {board.name} looks the same turned round ({why}): cameras may number its corners from "
        "different ends; better is an odd number of columns with an even one of rows, or ChArUco"
    )


def _untied(rig: Rig, good: list[ImageSequence]) -> list[str]:
    """Groups of pairs without a common shot: nothing can join them in one frame."""
    groups: list[tuple[set[str], set[str]]] = []  # pairs and their shots
    for pair in rig.pairs:
        pairs, shots = {pair.name}, {s.shot for s in good if s.pair == pair.name}
        if not shots:
            continue
        tied = [group for group in groups if group[1] & shots]
        for group in tied:
            groups.remove(group)
            pairs, shots = pairs | group[0], shots | group[1]
        groups.append((pairs, shots))
    if len(groups) < 2:
        return []
    named = " | ".join(", ".join(sorted(pairs)) for pairs, _ in groups)
    return [
        f"nothing ties these groups of pairs together, for no shot is theirs in common: {named}; "
        "take shots in which cameras of both see a board"
    ]


def _frame_errors(calibration: Captures, good: list[ImageSequence]) -> list[str]:
    frame = calibration.rig.rig_frame
    if missing := frame.missing_shot(calibration.shots):
        return [missing]
    if frame.shot is None or any(sequence.shot == frame.shot for sequence in good):
        return []
    return [f"rig_frame.shot: no pair has its images of '{frame.shot}', which fixes the rig frame"]


def _bad_lines(bad: tuple[BadImage, ...]) -> list[str]:
    """One line per pair, shot and fault, with the first file of each; one per pair and fault if
    many shots have it."""
    shots_of: dict[tuple[str, str], set[str]] = {}
    for image in bad:
        shots_of.setdefault((image.pair, image.what), set()).add(image.shot)

    def key(image: BadImage) -> tuple[str, str, str]:
        shots = shots_of[image.pair, image.what]
        where = f"{len(shots)} shots" if len(shots) > MANY_SHOTS else f"shot {image.shot}"
        return image.pair, where, image.what

    lines = []
    for (pair, where, what), group in groupby(sorted(bad, key=key), key=key):
        files = [image.path for image in group]
        rest = f" (and {len(files) - 1} more)" if len(files) > 1 else ""
        lines.append(f"error: pair {pair}, {where}: {files[0]}: {what}{rest}")
    return lines


def _several(count: int, noun: str) -> str:
    return f"{count} {noun}{'' if count == 1 else 's'}"
