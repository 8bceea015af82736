"""What the simulator writes: the rig file, captures.yaml, images and the truth."""

from __future__ import annotations

import os
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import Literal

import cv2

from bodyscan.arrays import Bytes
from bodyscan.captures.captures_file import CapturesFile, ShotEntry, write_captures_file
from bodyscan.captures.timing import Timing, times_of_frames
from bodyscan.rig.capture_folder import CaptureFolder
from bodyscan.rig.pair import Pair
from bodyscan.rig.rig import Rig
from bodyscan.simulation.settings import Pace

WHEN = datetime(2026, 11, 21, 10, 0, 0)
"""The date written into captures.yaml: always the same, so that the bytes are too."""

# Noise has no repetitions: Huffman coding of differences alone is quickest and smallest.
_PNG = [
    cv2.IMWRITE_PNG_COMPRESSION,
    1,
    cv2.IMWRITE_PNG_STRATEGY,
    cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY,
]
_PNG += [cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_SUB]


def scale_rig(rig: Rig, scale: float, calibration: str) -> Rig:
    """The rig with its image size and number of stripes scaled, and its captures in one folder."""

    def scaled(value: int) -> int:
        return max(2, round(value * scale))

    def resized(pair: Pair) -> Pair:
        camera, projector = pair.camera, pair.projector
        size = {"width": scaled(camera.width), "height": scaled(camera.height)}
        fewer = projector and projector.model_copy(update={"stripes": scaled(projector.stripes)})
        change = {"camera": camera.model_copy(update=size), "projector": fewer}
        return pair.model_copy(update=change)

    return rig.model_copy(
        update={
            "pairs": tuple(resized(pair) for pair in rig.pairs),
            "calibration": (CaptureFolder(folder=calibration),),
        }
    )


def write_captures(
    folder: Path,
    kind: Literal["calibration", "scan"],
    shots: Sequence[tuple[str, Sequence[str], Sequence[str]]],
    subject: str | None = None,
    pace: Pace | None = None,
) -> None:
    """Write captures.yaml: each shot's name, the pairs that took stripes, those that took only the
    lit image, and the timing if a pace is given."""
    entries = tuple(
        ShotEntry(name=name, stripes=tuple(stripes) or None, lit=tuple(lit) or None)
        for name, stripes, lit in shots
    )
    captures = CapturesFile(
        kind=kind,
        when=WHEN,
        subject=subject,
        simulated=True,
        shots=entries,
        timing=None if pace is None else timing_of(pace),
    )
    write_captures_file(folder, captures)


def timing_of(pace: Pace) -> Timing:
    """The timing for captures.yaml."""
    return Timing(frame_ms=pace.frame_ms, order=pace.order or None, start=pace.start)


def times_of_person(rig: Rig, shot: str, pace: Pace) -> dict[str, dict[str, float]]:
    """Times by pair, then by frame, ms since the first pair began."""
    taken = {(shot, pair.name): rig.frames.of_sequence(pair.projector) for pair in rig.pairs}
    times = times_of_frames(timing_of(pace), rig, taken, Path())
    return {pair: dict(times[shot, pair]) for shot, pair in taken}


def write_image(path: Path, image: Bytes) -> None:
    """Write an image, complete or not at all; PNG is packed quickly.

    Images are not flushed to the disk one by one: there are thousands, and they can be made again.
    """
    options = _PNG if path.suffix.lower() == ".png" else []
    _, packed = cv2.imencode(path.suffix, image, options)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.partial{path.suffix}")
    temporary.write_bytes(packed.tobytes())
    os.replace(temporary, path)
