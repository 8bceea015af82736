"""Make range images of all pairs of a scan, at once or while its images arrive.

A pair that fails is named and left out. Of a scan that is arriving a pair's images are decoded as soon
as they are there, so that after the last image only its own pair and the steps that join all pairs
remain.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import MappingProxyType

import numpy as np

from bodyscan.captures.captures_file import FILE_NAME
from bodyscan.captures.folder import Captures, ImageSequence, open_scan
from bodyscan.captures.images import read_colours
from bodyscan.errors import BadInput, BodyscanError, ScanFailed, format_list
from bodyscan.fusion.cleaning import cut_to_volume
from bodyscan.outcome import Outcome
from bodyscan.progress import THREADS, Progress, attempt_each, silent
from bodyscan.reconstruction.range_image import RangeImage
from bodyscan.reconstruction.scan_volume import find_stripes_in_volume
from bodyscan.reconstruction.triangulation import reconstruct_range_image
from bodyscan.registration.rig_calibration import RigCalibration
from bodyscan.registration.storage import calibration_id, load_calibration
from bodyscan.workflows.decode import decode_sequence, list_fault_notes

Reconstructed = tuple[RangeImage, tuple[str, ...]]
"""A range image, and what was wrong with the images, see `StripeMap.faults`."""


def reconstruct_sequence(
    calibration: RigCalibration,
    captures: Captures,
    sequence: ImageSequence,
    *,
    volume_only: bool = False,
) -> Reconstructed:
    """What one calibrated pair saw in one shot, in the scan volume and a little around it.

    volume_only: crop to the part of the image that shows the scan volume (`RangeImage.cut`).

    Raises ImageError and DecodingFailed as `decode_sequence` does.
    """
    pair, at = calibration.pairs[sequence.pair], calibration.rig_from_camera[sequence.pair]
    limits = find_stripes_in_volume(pair, at, calibration.rig.volume)
    spec = calibration.rig.pair(sequence.pair)
    stripes = decode_sequence(sequence, spec, limits=limits)
    image = replace(reconstruct_range_image(pair, stripes), rgb=read_colours(sequence, spec.camera))
    frame_ms = captures.frame_ms(sequence.shot, sequence.pair)
    if frame_ms is not None and spec.projector is not None:
        moment = calibration.rig.frames.moment_ms(spec.projector, frame_ms)
        span = min(frame_ms.values()), max(frame_ms.values())
        image = replace(image, time_ms=moment, span_ms=span)
    if volume_only:
        image = cut_to_volume(image, at, calibration.rig.volume)
    return image, stripes.faults


def reconstruct_range_images(
    calibration: RigCalibration,
    captures: Captures,
    progress: Progress = silent,
    *,
    made: Mapping[ImageSequence, Reconstructed] = MappingProxyType({}),
    volume_only: bool = False,
) -> Outcome[list[RangeImage]]:
    """The range image of every calibrated pair; pairs that gave none are in `failures`.

    made: range images made already, while other sequences were still arriving.
    volume_only: see `reconstruct_sequence`.

    Raises ScanFailed if no pair gives one, BadInput if no pair has a projector.
    """
    if not any(pair.projector for pair in calibration.rig.pairs):
        raise BadInput(
            "no pair has a projector, and cameras alone measure no surface here",
            where=f"rig {calibration.rig.name}",
            remedy="give a pair a `projector` in the rig file and calibrate it; a calibration of "
            "cameras alone is for other programs (`bodyscan export-rig`)",
        )
    failed = {}
    for name in (pair.name for pair in calibration.rig.pairs if pair.projector):
        if name not in calibration.pairs:
            why = calibration.failed.get(name, "it is not in the calibration")
            failed[name] = f"is not calibrated: {why.splitlines()[0]}"
        elif not any(s.has_stripes for s in captures.pair_sequences(name)):
            failed[name] = "took no stripe sequence in this scan"
    taken = [s for s in captures.sequences if s.has_stripes and s.pair not in failed]
    make = partial(reconstruct_sequence, calibration, captures, volume_only=volume_only)
    found, errors = attempt_each(
        lambda s: made.get(s) or make(s),
        taken,
        BodyscanError,
        stage="range images",
        progress=progress,
    )
    failed |= {s.pair: captures.relative(str(error)) for s, error in errors.items()}
    if not found:
        raise ScanFailed(f"no pair gave a range image:{format_list(failed)}")
    images = [image for image, _ in found.values()]
    empty = (image.pair for image in images if not np.isfinite(image.points).any())
    notes = [f"{pair}: nothing that it measured lies inside the rig's `volume`" for pair in empty]
    notes += map(captures.relative, list_fault_notes({s: f for s, (_, f) in found.items()}))
    return Outcome(images, tuple(notes), failed)


_Made = tuple[Reconstructed, tuple[tuple[int, int], ...]]
"""A range image and the stamps (size, time of change) of the files it was made from."""


class Preparation:
    """A calibration, loaded once, and the range images of scans that are still arriving."""

    def __init__(self, calibration: Path) -> None:
        """Raises CalibrationFileError as `load_calibration` does."""
        self._folder, self._id, self._pool = calibration, "", ThreadPoolExecutor(THREADS)
        self.refresh()

    def refresh(self) -> RigCalibration:
        """The calibration; if another is there than the one loaded before it is loaded, and what was
        made with that is dropped. Raises as `load_calibration` does."""
        found = ""  # before it is read: what replaces it meanwhile is loaded at the next request
        with suppress(BodyscanError, OSError):  # which `load_calibration` explains better
            found = calibration_id(self._folder)
        if not found or found != self._id:
            self.calibration: RigCalibration = load_calibration(self._folder)
            self._id, self._made = found, dict[Path, dict[ImageSequence, Future[_Made | None]]]()
        return self.calibration

    def prepare(self, folder: Path, pairs: Collection[str]) -> None:
        """Start decoding what these pairs took, if all of it is there.

        Any number of pairs may be named in each call; as many are decoded at a time as there are
        threads. Nothing is raised: faults are left to the scan, which tries again and reports them.
        """
        try:
            calibration = self.refresh()
            captures = open_scan(calibration.rig, folder)
        except BodyscanError:
            return
        wanted = [
            s
            for s in captures.sequences
            if s.pair in calibration.pairs.keys() & pairs and s.has_stripes and not s.missing
        ]

        def make(sequence: ImageSequence) -> _Made | None:
            stamps = _read_stamps(captures, sequence)
            try:
                made = reconstruct_sequence(calibration, captures, sequence, volume_only=True)
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
            if one is not None and _read_stamps(captures, sequence) == one[1]
        }

    def drop(self, folder: Path) -> None:
        """Drop what was made of a scan and not taken, as when its earlier result was up to date."""
        self._made.pop(folder, None)


def _read_stamps(captures: Captures, sequence: ImageSequence) -> tuple[tuple[int, int], ...]:
    """Stamps of the images and of captures.yaml, which says when they were taken; (0, 0) for a
    missing file."""
    stamps = []
    for path in (*(folder / FILE_NAME for folder in captures.folders), *sequence.paths):
        stamps.append((0, 0))
        with suppress(OSError):
            found = path.stat()
            stamps[-1] = found.st_size, found.st_mtime_ns
    return tuple(stamps)
