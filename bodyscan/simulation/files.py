"""What the simulator writes: rig file, captures, images, and the truth as JSON."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from datetime import datetime
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from bodyscan.arrays import Bytes
from bodyscan.captures.captures_file import (
    CapturesFile,
    ShotEntry,
    Timing,
    compute_frame_times,
    write_captures_file,
)
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.rig.frame_names import CaptureFolder
from bodyscan.rig.pair import Pair
from bodyscan.rig.rig import Rig
from bodyscan.simulation.board import MadeBoard
from bodyscan.simulation.layout import TruePair
from bodyscan.simulation.lens import TrueCamera
from bodyscan.simulation.living import LivingBody, describe_motion
from bodyscan.simulation.plan import BoardShot
from bodyscan.simulation.projector import MirrorProjector
from bodyscan.simulation.scene import Surface
from bodyscan.simulation.settings import Pace, SimulationSettings


def scale_rig(rig: Rig, scale: float, calibration: str) -> Rig:
    """Scale a rig's image size and number of stripes; its captures lie in one folder."""

    def scale_count(value: int) -> int:
        return max(2, round(value * scale))

    def scale_pair(pair: Pair) -> Pair:
        camera, projector = pair.camera, pair.projector
        size = {"width": scale_count(camera.width), "height": scale_count(camera.height)}
        fewer = projector and projector.model_copy(
            update={"stripes": scale_count(projector.stripes)}
        )
        change = {"camera": camera.model_copy(update=size), "projector": fewer}
        return pair.model_copy(update=change)

    return rig.model_copy(
        update={
            "pairs": tuple(scale_pair(pair) for pair in rig.pairs),
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
    """Write captures.yaml: shots, each with pairs that took stripes and pairs that took lit only."""
    entries = tuple(
        ShotEntry(name=name, stripes=tuple(stripes) or None, lit=tuple(lit) or None)
        for name, stripes, lit in shots
    )
    captures = CapturesFile(
        kind=kind,
        when=datetime(2026, 11, 21, 10, 0, 0),  # the same bytes whenever it is run
        subject=subject,
        simulated=True,
        shots=entries,
        timing=None if pace is None else timing_from_pace(pace),
    )
    write_captures_file(folder, captures)


def timing_from_pace(pace: Pace) -> Timing:
    """Make the timing for captures.yaml."""
    return Timing(frame_ms=pace.frame_ms, order=pace.order or None, start=pace.start)


def compute_person_times(rig: Rig, shot: str, pace: Pace) -> dict[str, dict[str, float]]:
    """Compute times by pair, then by frame, ms since the first pair began."""
    taken = {(shot, pair.name): rig.frames.sequence_names(pair.projector) for pair in rig.pairs}
    times = compute_frame_times(timing_from_pace(pace), rig, taken, Path())
    return {pair: dict(times[shot, pair]) for shot, pair in taken}


def write_image(path: Path, image: Bytes) -> None:
    """Write an image, complete or not at all; PNG is packed quickly.

    Images are not flushed to the disk one by one: there are thousands, and they can be made again.
    """
    # Noise has no repetitions: Huffman coding of differences alone is quickest and smallest.
    png = [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_SUB]
    png += [cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY]
    options = png if path.suffix.lower() == ".png" else []
    _, packed = cv2.imencode(path.suffix, image, options)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.partial{path.suffix}")
    temporary.write_bytes(packed.tobytes())
    os.replace(temporary, path)


KEYS = {
    "pairs.*.camera": "alpha, beta, gamma, u0, v0 (px), k1, k2 (Eq. 1-5), width, height (px); of a "
    "lens that has more (brown) p1, p2, k3, as OpenCV numbers them",
    "pairs.*.rig_from_camera": "4x4, camera coordinates to rig coordinates, mm",
    "pairs.*.projector": "see bodyscan/simulation/projector.py; vectors in the camera frame, mm",
    "pairs.*.projector.kind": "mirror or pinhole",
    "pairs.*.boundary_planes": "mirror only: a, b, c (unit normal), d (mm) of Eq. 6 in the camera "
    "frame, of the boundaries s = 0..S, before any smile",
    "pairs.*.swayed_from_still": "4x4, where the person of truth/subject.ply stood when this pair "
    "captured it, rig frame, mm",
    "shots.*.rig_from_board": "4x4, board coordinates to rig coordinates, mm",
    "boards.*.corners_mm": "where the printed inner corners really are, board frame (front, then "
    "back), if the board is not perfect",
    "settings": "see bodyscan/simulation/settings.py for the meaning and unit of each",
    "subject": "pseudonym; its surface is subject.ply, mm, rig frame",
    "motion": "of a living person: subject.ply shows moment_ms since the scan began, "
    "subject-mean-breath.ply the same at mean breath; bodyscan.simulation.living.load_body tells "
    "where each vertex was at any time from this and body.npz; swayed_from_still is the trunk's motion "
    "from moment_ms to the middle of the pair's frames",
}


@dataclass(frozen=True, eq=False)
class Motion:
    """A living person and when each frame is taken."""

    body: LivingBody
    times: Mapping[str, Mapping[str, float]]  # by pair, then by frame, ms
    moment_ms: float  # the middle of all times, which the truth's surface shows

    def middle_ms(self, pair: str) -> float:
        """Compute the middle of the time in which a pair takes its frames."""
        return (min(self.times[pair].values()) + max(self.times[pair].values())) / 2.0

    def trunk(self, pair: str) -> RigidTransform:
        """Compute `swayed_from_still` of the trunk at the middle of a pair's frames."""
        ankles = self.body.ankles
        return ankles.motion(self.middle_ms(pair)) @ ankles.motion(self.moment_ms).inverse()


@dataclass(frozen=True, eq=False)
class Truth:
    """Everything that is decided before an image is made."""

    rig: str
    seed: int
    settings: SimulationSettings
    pairs: Mapping[str, TruePair]
    boards: Mapping[str, MadeBoard]
    plan: tuple[BoardShot, ...]
    subject: str | None
    person: Surface | None  # the subject's surface in the rig frame, standing still
    # By pair, `swayed_from_still` of the person when that pair captures.
    sways: Mapping[str, RigidTransform]
    motion: Motion | None = None  # what the person does meanwhile; None if they do not move


def describe(truth: Truth) -> dict[str, Any]:
    """Describe the truth as JSON values, without the subject's surface."""
    making, motion = truth.settings.board, truth.motion
    perfect = not any((making.bow_mm, making.warp_mm[1], making.print_error_mm))
    return {
        "version": 1,
        "keys": KEYS,
        "rig": truth.rig,
        "seed": truth.seed,
        "subject": truth.subject,
        "pairs": {name: _pair(pair, truth.sways.get(name)) for name, pair in truth.pairs.items()},
        "shots": {
            shot.name: {"board": shot.board, "rig_from_board": shot.rig_from_board.matrix}
            for shot in truth.plan
        },
        "boards": {}
        if perfect
        else {name: {"corners_mm": board.corners} for name, board in truth.boards.items()},
        "settings": asdict(truth.settings),
    } | ({"motion": describe_motion(motion.body, motion.moment_ms)} if motion else {})


def _pair(pair: TruePair, sway: RigidTransform | None) -> dict[str, Any]:
    document: dict[str, Any] = {
        "camera": describe_camera(pair.camera),
        "rig_from_camera": pair.rig_from_camera.matrix,
        "projector": {
            "kind": "mirror" if isinstance(pair.projector, MirrorProjector) else "pinhole",
            **{f.name: getattr(pair.projector, f.name) for f in fields(pair.projector)},
        },
    }
    if isinstance(pair.projector, MirrorProjector):
        planes = pair.projector.plane(np.arange(pair.projector.stripes + 1.0))
        document["boundary_planes"] = planes
    if sway is not None:
        document["swayed_from_still"] = sway.matrix
    return document


def describe_camera(camera: TrueCamera) -> dict[str, Any]:
    """Describe a camera as in calibration files, without a lens kind if it is the chapter's."""
    values, more = asdict(camera), ("p1", "p2", "k3")
    if any(values[name] for name in more):
        return {"lens": "brown"} | values
    return {name: value for name, value in values.items() if name not in more}
