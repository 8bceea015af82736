"""An inbox: one folder per scan, whose images are still being written.

An image is whole if it ends as its format does, or has not changed for a while; a pair is whole if
all its images are; a scan is complete if all pairs are whole, or `done` is in its folder, or
nothing has arrived for long. docs/inbox.md is the protocol.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import cv2

from bodyscan.arrays import Bytes
from bodyscan.captures.captures_file import FILE_NAME as CAPTURES
from bodyscan.captures.folder import ImageSequence, open_scan
from bodyscan.errors import BadInput, CaptureError
from bodyscan.files.atomic import write_bytes
from bodyscan.files.hashing import list_files
from bodyscan.rig.rig import Rig
from bodyscan.rig.templates import ANYTHING, fill

STABLE_S = 0.5
"""An image without an end mark is whole when it has not grown for this long: camera drivers write a
file in one go, in hundredths of a second."""


@dataclass(frozen=True)
class Arrival:
    """What has arrived of a scan. whole: pairs with all their images. complete: nothing more is
    expected."""

    whole: tuple[str, ...]
    complete: bool


@dataclass(frozen=True)
class _File:
    size: int
    changed_ns: int
    since_s: float
    whole: bool


def put_image(
    inbox: Path, rig: Rig, scan: str, pair: str, frame: str, image: Bytes, *, shot: str = "s01"
) -> Path:
    """Write an image from memory to where `watch` expects that frame; returns its path.

    image: (height, width) uint8 or uint16. The file appears complete or not at all.

    Raises BadInput for a pair, or a template of `files`, that yields no image name.
    """
    if pair not in {one.name for one in rig.pairs}:
        raise BadInput(f"rig {rig.name} has no pair {pair}", where=f"scan {scan}, frame {frame}")
    name = fill(rig.files, shot=shot, pair=pair, frame=frame)
    lossless = (".png", ".tif", ".tiff", ".bmp", ".pgm")
    if ANYTHING in name or Path(name).suffix.lower() not in lossless:
        raise BadInput(
            f"`files` is {rig.files}, by which no image can be written",
            where=f"rig {rig.name}",
            remedy=f"calibrate with a template that has no * and ends in one of {lossless}",
        )
    path = Path(inbox) / scan / name
    path.parent.mkdir(parents=True, exist_ok=True)
    quickly = [cv2.IMWRITE_PNG_COMPRESSION, 1] if path.suffix.lower() == ".png" else []
    write_bytes(path, cv2.imencode(path.suffix, image, quickly)[1].tobytes())
    return path


class IncomingScan:
    """One scan's folder, examined repeatedly."""

    def __init__(self, folder: Path, rig: Rig) -> None:
        self.folder, self.rig = folder, rig
        self._files: dict[Path, _File] = {}
        self._changed_s: float | None = None

    def look(self, now_s: float, quiet_s: float) -> Arrival:
        """Look at what is there now.

        now_s: of a monotonic clock.
        quiet_s: a scan to which nothing was added for this long is taken as it is.
        """
        if self._look_for_changes(now_s) or self._changed_s is None:
            self._changed_s = now_s
        try:
            sequences = open_scan(self.rig, self.folder).sequences
        except CaptureError:
            sequences = ()  # nothing yet, or an error that the scan itself will report
        striped = [sequence for sequence in sequences if sequence.has_stripes]
        whole = {sequence.pair for sequence in striped if self._is_whole(sequence, now_s)}
        if (self.folder / CAPTURES).exists():
            expected = {sequence.pair for sequence in striped}
        else:
            expected = {pair.name for pair in self.rig.pairs if pair.projector is not None}
        is_marked = (self.folder / "done").exists()
        complete = is_marked or (bool(whole) and expected <= whole)
        complete |= now_s - self._changed_s >= quiet_s
        return Arrival(tuple(sorted(whole)), complete)

    def _is_whole(self, sequence: ImageSequence, now_s: float) -> bool:
        if sequence.missing:
            return False
        there = [self._files[path] for path in sequence.paths if path in self._files]
        whole = [one.whole or now_s - one.since_s >= STABLE_S for one in there]
        return len(there) == len(sequence.paths) and all(whole)

    def _look_for_changes(self, now_s: float) -> bool:
        """Check every file in the folder; returns whether one came, went or changed."""
        before, self._files = self._files, {}
        for path in list_files(self.folder):
            try:
                found = os.stat(path)
            except OSError:
                continue
            stamp = (found.st_size, found.st_mtime_ns)
            known = before.get(path)
            if known is None or stamp != (known.size, known.changed_ns):
                known = _File(*stamp, now_s, _has_end_mark(path, found.st_size))
            self._files[path] = known
        return before != self._files


def _has_end_mark(path: Path, size: int) -> bool:
    """Whether the last bytes show that the file is complete; False for formats without an end mark."""
    ends = {".png": b"IEND\xaeB`\x82", ".jpg": b"\xff\xd9", ".jpeg": b"\xff\xd9"}
    end = ends.get(path.suffix.lower())
    if end is None or size < len(end) or not path.is_file():
        return False
    try:
        with path.open("rb") as stream:
            stream.seek(-len(end), os.SEEK_END)
            return stream.read() == end
    except OSError:
        return False
