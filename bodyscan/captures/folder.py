"""Capture folders: where each image of each pair and shot lies, and which are missing."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import Literal

from bodyscan.captures.captures_file import (
    FILE_NAME,
    FrameTimes,
    ShotEntry,
    Timing,
    compute_frame_times,
    load_captures_file,
)
from bodyscan.captures.listing import Listing
from bodyscan.errors import CaptureError
from bodyscan.files.corners_vnl import Corners, read_corners
from bodyscan.files.messages import make_paths_relative
from bodyscan.files.model import MAX_SHOT_LENGTH, SHOT
from bodyscan.rig.frame_names import CaptureFolder
from bodyscan.rig.pair import Pair
from bodyscan.rig.rig import Rig
from bodyscan.rig.templates import compile_shot_pattern, fill, has_field

IMAGE_SUFFIXES = {".png", ".bmp", ".tif", ".tiff", ".jpg", ".jpeg", ".pgm", ".ppm"}
"""Suffixes of image files, whatever program wrote them."""

Kind = Literal["calibration", "scan"]


@dataclass(frozen=True)
class ImageSequence:
    """The images that one pair took, or should have taken, in one shot."""

    pair: str
    shot: str
    # lit, dark, board: None if there is no such image.
    lit: Path | None
    dark: Path | None
    # The images of the stripe code, in the order of `FrameNames.code_names`; () if only the lit or
    # the board image was taken.
    coded: tuple[Path, ...]
    missing: tuple[Path, ...]  # the paths that do not exist
    board: Path | None = None
    exposure: str = ""  # its name, if the rig file names several
    longer: tuple[ImageSequence, ...] = ()  # the same images with the others
    inverses: tuple[Path, ...] = ()  # those among `coded`
    crossing: tuple[Path, ...] = ()  # images that show the crossing stripes, of all exposures

    @property
    def where(self) -> str:
        """Pair and shot, for messages."""
        return f"pair {self.pair}, shot {self.shot}"

    @property
    def without_crossing(self) -> ImageSequence:
        """The same sequence without its crossing stripes."""

        def rest(paths: tuple[Path, ...]) -> tuple[Path, ...]:
            return tuple(path for path in paths if path not in self.crossing)

        return replace(
            self,
            coded=rest(self.coded),
            inverses=rest(self.inverses),
            missing=rest(self.missing),
            longer=tuple(longer.without_crossing for longer in self.longer),
            crossing=(),
        )

    @property
    def has_stripes(self) -> bool:
        """Whether this is a stripe sequence rather than a lit image alone."""
        return bool(self.coded)

    @property
    def paths(self) -> tuple[Path, ...]:
        """Lit, dark and board image if there are any, the code's, then those of longer exposures."""
        single = filter(None, (self.lit, self.dark, self.board))
        return (*single, *self.coded, *(path for longer in self.longer for path in longer.paths))

    @property
    def board_path(self) -> Path:
        """The image in which boards are detected; the code's first if it has to be made of these."""
        return self.board or self.lit or self.coded[0]


@dataclass(frozen=True)
class Captures:
    """What one or more capture folders hold.

    shots: in order.
    sequences: by shot, then by pair.
    when, subject, simulated: of a scan, from its captures.yaml.
    corners: of the board, px, for images in which another program found it; () where it did not.
    base: the folder to which stored messages are relative: the rig file's, or the scan's.
    times: when frames were taken, if the captures say so.
    described_in: the files that say that and the rest.
    """

    rig: Rig
    folders: tuple[Path, ...]
    shots: tuple[str, ...]
    sequences: tuple[ImageSequence, ...]
    when: datetime | None = None
    subject: str | None = None
    simulated: bool = False
    base: Path = Path()
    corners: Mapping[Path, Corners] = field(default_factory=dict)
    times: FrameTimes = field(default_factory=dict)
    described_in: tuple[Path, ...] = ()

    def pair_sequences(self, pair: str) -> tuple[ImageSequence, ...]:
        return tuple(sequence for sequence in self.sequences if sequence.pair == pair)

    def shot_sequences(self, shot: str) -> tuple[ImageSequence, ...]:
        return tuple(sequence for sequence in self.sequences if sequence.shot == shot)

    def frame_ms(self, shot: str, pair: str) -> dict[str, float] | None:
        """Return when a pair took each frame of a shot, by the frame's name, in the order taken.

        In ms from the moment the first pair began to the middle of the exposure; None if unknown.
        """
        times = self.times.get((shot, pair))
        return None if times is None else dict(times)

    def relative(self, text: str) -> str:
        """Make the paths in a message relative to `base`, so that it can be stored."""
        return make_paths_relative(text, self.base, self.folders)


def open_captures(rig: Rig, rig_path: Path) -> Captures:
    """Open the calibration captures that a rig file names, and join its folders.

    Raises CaptureError if it names none, and as `open_folder` and `join_captures` do.
    """
    if not rig.calibration:
        raise CaptureError(
            "the rig file names no calibration captures",
            where=str(rig_path),
            remedy="All its pairs are `known`: take them as they are with `bodyscan import`."
            if rig.is_known
            else "Add `calibration:` with a folder; docs/formats.md shows how.",
        )
    parts = tuple(open_folder(rig, rig_path, entry) for entry in rig.calibration)
    return replace(join_captures(parts), base=Path(rig_path).parent)


def open_folder(rig: Rig, rig_path: Path, entry: CaptureFolder) -> Captures:
    """Open one folder of the rig file's `calibration` list. Raises as `open_scan`."""
    folder, template = resolve_capture_path(rig_path, entry), entry.files or rig.files
    if entry.corners is None:
        empty = folder.is_dir() and not any(folder.iterdir())
        if empty or not (folder.exists() or "\\" in str(folder)):
            raise CaptureError(
                f"the capture folder {'is empty' if empty else 'does not exist'}",
                where=str(folder),
                remedy="Take shots of the board first (`bodyscan capture RIG --out FOLDER --board "
                "SHOT`); if they are taken, check the name, and that the disk is connected.",
            )
        return _open(rig, folder, "calibration", template, entry.shots)

    # Wherever the images were for the other program, the last parts of their paths are the same.
    last, corners = template.count("/") + 1, read_corners(Path(rig_path).parent / entry.corners)
    named = {"/".join(name.split("/")[-last:]): pixels for name, pixels in corners.items()}
    captures = _open(rig, folder, "calibration", template, entry.shots, tuple(named))
    return replace(captures, corners={folder / name: pixels for name, pixels in named.items()})


def resolve_capture_path(rig_path: Path, entry: CaptureFolder) -> Path:
    """Return the path of a folder, with .. resolved if that leads to the same folder."""
    path = Path(rig_path).parent / entry.folder
    short = os.path.normpath(path)  # differs if a symbolic link comes before ..
    return Path(short) if os.path.realpath(short) == os.path.realpath(path) else path


def open_scan(rig: Rig, folder: Path) -> Captures:
    """Open the captures of one scan.

    Raises CaptureError if the folder does not exist, if its captures.yaml is wrong or says that
    this is no scan, if it holds no image of this rig, or if a symbolic link leads out of it and the
    rig does not follow links.
    """
    return _open(rig, Path(folder), "scan", rig.files, None)


def open_check(rig: Rig, folder: Path) -> tuple[Kind, Captures]:
    """Open captures of either kind, for a check. Raises as `open_scan`.

    The kind is that of the folder's captures.yaml; without one, a scan unless there are more shots.
    """
    listing = Listing(Path(folder), follow_links=rig.follow_links)
    file = load_captures_file(folder, rig) if listing.has(FILE_NAME, broken=True) else None
    kind: Kind = file.kind if file is not None else "scan"
    captures = _open(rig, Path(folder), kind, rig.files, None)
    if file is None and len(captures.shots) > 1:
        kind = "calibration"
    return kind, captures


def join_captures(parts: tuple[Captures, ...]) -> Captures:
    """Join captures of several folders; shots with the same name are the same moment.

    Raises CaptureError if two folders hold the same shot of the same pair.
    """
    folder_of: dict[tuple[str, str], Path] = {}
    for part in parts:
        for sequence in part.sequences:
            key = (sequence.pair, sequence.shot)
            if key in folder_of:
                raise CaptureError(
                    f"shot {sequence.shot} of pair {sequence.pair} is in {folder_of[key]} as well",
                    where=str(part.folders[0]),
                    remedy="Rename one of the shots, or leave it out with `shots:` in rig.yaml.",
                )
            folder_of[key] = part.folders[0]
    shots = tuple(dict.fromkeys(shot for part in parts for shot in part.shots))
    order = {pair.name: k for k, pair in enumerate(parts[0].rig.pairs)}
    sequences = [sequence for part in parts for sequence in part.sequences]
    sequences.sort(key=lambda sequence: (shots.index(sequence.shot), order[sequence.pair]))
    folders = tuple(folder for part in parts for folder in part.folders)
    return replace(
        parts[0],
        folders=folders,
        shots=shots,
        sequences=tuple(sequences),
        corners={path: pixels for part in parts for path, pixels in part.corners.items()},
        times={key: times for part in parts for key, times in part.times.items()},
        described_in=tuple(path for part in parts for path in part.described_in),
    )


def _open(
    rig: Rig,
    folder: Path,
    kind: Kind,
    template: str,
    wanted: tuple[str, ...] | None,
    named: tuple[str, ...] = (),
) -> Captures:
    """Open a folder's captures of one kind.

    wanted: shots, instead of those that captures.yaml lists or that are found.
    named: files that count as present, since their corners are known.
    """
    listing = Listing(folder, follow_links=rig.follow_links, named=named)
    file = load_captures_file(folder, rig) if listing.has(FILE_NAME, broken=True) else None
    if file is not None and file.kind != kind:
        raise CaptureError(
            f"is of kind {file.kind}, but {kind} captures are wanted here",
            where=str(folder / FILE_NAME),
            remedy="Name the right folder, or correct `kind` in its captures.yaml.",
        )
    first = template.replace("{exposure}", rig.exposures[0]) if rig.exposures else template
    entries = {shot.name: shot for shot in (file.shots if file else None) or ()}
    names = wanted or tuple(entries) or _discover_shots(rig, listing, first)
    if not has_field(template, "shot") and len(names) > 1:
        raise CaptureError(
            f"holds one shot by the template {template}, but {len(names)} are listed",
            where=str(folder),
            remedy="Put {shot} into the template, or list one shot.",
        )
    shots = [entries.get(name, ShotEntry(name=name)) for name in names]
    sequences = tuple(
        sequence for shot in shots for sequence in _collect_sequences(rig, listing, template, shot)
    )
    if not sequences:
        raise _make_no_image_error(rig, folder, template, first)
    captures = Captures(rig, (folder,), names, sequences, base=folder)
    if file is None:
        return captures
    files = (FILE_NAME, file.timing and file.timing.times)
    return replace(
        captures,
        when=file.when,
        subject=file.subject,
        simulated=bool(file.simulated),
        times=_read_times(captures, listing, file.timing) if file.timing else {},
        described_in=tuple(folder / name for name in files if name),
    )


def _make_no_image_error(rig: Rig, folder: Path, template: str, first: str) -> CaptureError:
    """Make the error for a folder without images; first: the template of the first exposure."""
    frame = next(iter(rig.frames.sequence_names(rig.pairs[0].projector)), "")
    example = fill(first, shot="SHOT", pair=rig.pairs[0].name, frame=frame)
    return CaptureError(
        f"holds no image of rig {rig.name} by the template {template}, such as {example}",
        where=str(folder),
        remedy="Possible causes: it is the folder of a single shot (give the folder above it, or take "
        "{shot}/ out of `files` in the rig file); `files` does not say how images are named (capitals "
        "and small letters count).",
    )


def _read_times(captures: Captures, listing: Listing, timing: Timing) -> FrameTimes:
    """Read when frames were taken."""
    if timing.times is not None and not listing.has(timing.times):
        raise CaptureError(
            f"names the file of times {timing.times}, which does not exist",
            where=str(listing.root / FILE_NAME),
            remedy="Copy it into the capture folder, or remove `timing`.",
        )
    frames = captures.rig.frames
    taken = {
        (one.shot, one.pair): frames.sequence_names(captures.rig.pair(one.pair).projector)
        if one.has_stripes
        else frames.sequence_names(None)
        for one in captures.sequences
    }
    return compute_frame_times(timing, captures.rig, taken, listing.root)


def _discover_shots(rig: Rig, listing: Listing, template: str) -> tuple[str, ...]:
    """Find shots by the names of files: those with a lit or board image or a code's first image; names
    that are too long are dropped. Without `{shot}` the folder's own name is the only shot; raises
    CaptureError if that is no valid one."""
    if not has_field(template, "shot"):
        name = listing.root.resolve().name
        if re.fullmatch(SHOT, name) and len(name) <= MAX_SHOT_LENGTH:
            return (name,)
        raise CaptureError(
            "the folder's name is not a valid shot name",
            where=str(listing.root),
            remedy="Rename the folder (a letter, a digit or '_' first), or list its shot.",
        )
    found: set[str] = set()
    for pair in rig.pairs:
        frames = {rig.frames.lit, rig.frames.board} - {None}
        if pair.projector:
            frames |= set(rig.frames.code_names(pair.projector)[:1])
        for frame in filter(None, frames):
            found |= _find_shots(
                listing, compile_shot_pattern(template, pair.name, frame), "", None
            )
    return tuple(
        sorted((name for name in found if len(name) <= MAX_SHOT_LENGTH), key=_make_natural_key)
    )


def _find_shots(
    listing: Listing, parts: tuple[re.Pattern[str], ...], folder: str, shot: str | None
) -> set[str]:
    """Find names of shots for which a path below `folder` matches the patterns, part by part."""
    found: set[str] = set()
    for name in listing.names(folder):
        match = parts[0].fullmatch(name)
        if match is None:
            continue
        named = match.groupdict().get("shot", shot)
        if shot is not None and named != shot:
            continue
        if len(parts) > 1:
            found |= _find_shots(listing, parts[1:], f"{folder}/{name}".lstrip("/"), named)
        elif named is not None:
            found.add(named)
    return found


def _make_natural_key(name: str) -> tuple[tuple[int, int, str], ...]:
    """Return a sort key that puts b2 before b10."""
    pieces = re.findall(r"\d+|\D+", name)
    return tuple((0, int(p), p) if p.isdecimal() else (1, 0, p) for p in pieces)


def _collect_sequences(
    rig: Rig, listing: Listing, template: str, shot: ShotEntry
) -> Iterator[ImageSequence]:
    """Collect what each pair took in a shot, by captures.yaml or, without a list, by the files."""
    look = shot.stripes is None and shot.lit is None
    templates = {name: template.replace("{exposure}", name) for name in rig.exposures or ("",)}
    first = next(iter(templates.values()))
    frames = rig.frames.sequence_names(None) if has_field(first, "frame") else ("",)
    for pair in rig.pairs:
        whole = _collect_stripes(rig, listing, templates, shot.name, pair)
        paths, missing = _locate(listing, first, shot.name, pair, frames)
        alone = ImageSequence(pair.name, shot.name, paths[0], None, (), missing) if paths else None
        stripes, lit = pair.name in (shot.stripes or ()), pair.name in (shot.lit or ())
        if (stripes and not whole.coded) or (lit and alone is None):
            raise CaptureError(
                f"lists pair {pair.name} in `{'stripes' if stripes else 'lit'}` of shot {shot.name}, "
                f"but the rig file names no such image (template {template})",
                where=str(listing.root / FILE_NAME),
                remedy="Possible causes: its `files` has no {frame}; it has `lit: null`.",
            )
        if stripes or (look and set(whole.coded) - set(whole.missing)):
            yield whole
        elif alone is not None and (lit or (look and not alone.missing)):
            yield alone


def _collect_stripes(
    rig: Rig, listing: Listing, templates: Mapping[str, str], shot: str, pair: Pair
) -> ImageSequence:
    """Collect the whole sequence, templates by exposure; empty for a camera without a projector."""
    found = []
    for exposure, template in templates.items():
        code = pair.projector if has_field(template, "frame") else None
        if code is None:
            return ImageSequence(pair.name, shot, None, None, (), ())
        frames, names = rig.frames.sequence_names(code), rig.frames
        paths, missing = _locate(listing, template, shot, pair, frames)
        path_of = dict(zip(frames, paths, strict=True))
        lit, dark, board = (
            path_of.get(name or "") for name in (names.lit, names.dark, names.board)
        )
        coded = tuple(path_of[name] for name in names.code_names(code))
        counts = [each for one in code.directions for each in one.image_counts.items()]
        kinds = [kind.name for kind, count in counts for _ in range(count)]
        inverses = tuple(p for p, kind in zip(coded, kinds, strict=True) if kind == "inverse")
        crossing = coded[sum(code.image_counts.values()) :]
        found.append(
            ImageSequence(
                pair.name, shot, lit, dark, coded, missing, board, exposure, (), inverses, crossing
            )
        )
    return replace(
        found[0],
        missing=tuple(path for one in found for path in one.missing),
        longer=tuple(found[1:]),
        crossing=tuple(path for one in found for path in one.crossing),
    )


def _locate(
    listing: Listing, template: str, shot: str, pair: Pair, frames: Iterable[str]
) -> tuple[tuple[Path, ...], tuple[Path, ...]]:
    """Locate a pair's images in a shot: all paths, and those that do not exist."""
    wanted = (fill(template, shot=shot, pair=pair.name, frame=frame) for frame in frames)
    names = [listing.find(name) for name in wanted]
    missing = tuple(listing.root / name for name in names if not listing.has(name))
    return tuple(listing.root / name for name in names), missing
