"""Prepare a scan while it arrives: load the calibration, make range images of complete pairs.

A pair's images are decoded as soon as they are there, while other pairs still take theirs. After
the last image, only its own pair and the steps that join all pairs remain.
"""

from __future__ import annotations

from collections.abc import Collection
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from bodyscan.captures.captures_file import FILE_NAME
from bodyscan.captures.folder import Captures, ImageSequence, open_scan
from bodyscan.errors import BodyscanError
from bodyscan.progress import THREADS
from bodyscan.registration.rig_calibration import RigCalibration
from bodyscan.registration.storage import load_calibration
from bodyscan.workflows.range_images import Reconstructed, reconstruct_sequence

Stamp = tuple[int, int]


_Made = tuple[Reconstructed, tuple[Stamp, ...]]
"""A range image and the stamps (size, time of change) of the files it was made from."""


class Preparation:
    """A calibration, loaded once, and the range images of scans that are still arriving."""

    def __init__(self, calibration: Path) -> None:
        """Raises CalibrationFileError as `load_calibration` does."""
        self.calibration: RigCalibration = load_calibration(calibration)
        self._pool = ThreadPoolExecutor(THREADS)
        self._made: dict[Path, dict[ImageSequence, Future[_Made | None]]] = {}

    def prepare(self, folder: Path, pairs: Collection[str]) -> None:
        """Start decoding what these pairs took, if all of it is there.

        Any number of pairs may be named in each call; as many are decoded at a time as there are
        threads. Nothing is raised: faults are left to the scan, which tries again and reports them.
        """
        try:
            captures = open_scan(self.calibration.rig, folder)
        except BodyscanError:
            return
        wanted = [s for s in captures.sequences if s.pair in pairs and self._is_whole(s)]

        def make(sequence: ImageSequence) -> _Made | None:
            stamps = _stamps(captures, sequence)
            try:
                made = reconstruct_sequence(self.calibration, captures, sequence, volume_only=True)
            except BodyscanError:
                return None
            return made, stamps

        started = self._made.setdefault(folder, {})
        started |= {sequence: self._pool.submit(make, sequence) for sequence in wanted}

    def take(self, captures: Captures) -> dict[ImageSequence, Reconstructed]:
        """Hand over the range images of these captures whose files have not changed since.

        Waits for those being made. They are handed over once, so that none is kept twice.
        """
        made: dict[ImageSequence, Future[_Made | None]] = {}
        for folder in captures.folders:
            made |= self._made.pop(folder, {})
        found = {sequence: one.result() for sequence, one in made.items()}
        return {
            sequence: one[0]
            for sequence, one in found.items()
            if one is not None and _stamps(captures, sequence) == one[1]
        }

    def _is_whole(self, sequence: ImageSequence) -> bool:
        calibrated = sequence.pair in self.calibration.pairs
        return calibrated and sequence.has_stripes and not sequence.missing


def _stamps(captures: Captures, sequence: ImageSequence) -> tuple[Stamp, ...]:
    """Stamps of the images and of captures.yaml, which says when they were taken; (0, 0) for a
    missing file."""
    stamps = []
    for path in (*(folder / FILE_NAME for folder in captures.folders), *sequence.paths):
        try:
            found = path.stat()
        except OSError:
            stamps.append((0, 0))
        else:
            stamps.append((found.st_size, found.st_mtime_ns))
    return tuple(stamps)
