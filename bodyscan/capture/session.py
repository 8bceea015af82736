"""A shot taken by a rig's devices and written as a capture folder, or into an inbox.

captures.yaml comes first. Of each turn the times come before the images, so that whoever watches the
folder finds every image with its time.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import datetime
from itertools import zip_longest
from pathlib import Path
from typing import Literal

from pydantic import ValidationError

from bodyscan.capture.cameras import HOST, FrameLost, Picture
from bodyscan.capture.devices import Devices
from bodyscan.captures.captures_file import (
    FILE_NAME,
    CapturesFile,
    ShotEntry,
    Timing,
    load_captures_file,
    write_captures_file,
)
from bodyscan.errors import BadInput, CaptureError
from bodyscan.files.atomic import write_text
from bodyscan.files.model import describe_first_error
from bodyscan.jobs.watching import put_image
from bodyscan.progress import Progress, background, silent
from bodyscan.rig.devices import Order
from bodyscan.rig.pair import Pair
from bodyscan.rig.rig import Rig

TIMES = "times.csv"
_HEADER = "shot,pair,frame,ms"

Frame = tuple[str, str]
"""A pair and the name of a frame."""
Step = tuple[Frame, ...]
"""Pairs, each with the frame that it takes; all of a step at the same time."""
Turn = tuple[Step, ...]
"""Steps that belong together: images of a turn are written when all of it is taken."""


@dataclass(frozen=True)
class Shot:
    """What is to be taken, and where it goes."""

    folder: Path  # of the captures
    name: str = "s01"
    kind: Literal["scan", "calibration"] = "scan"
    subject: str | None = None
    timeout_s: float = 5.0


@dataclass(frozen=True)
class Captured:
    """A shot that was taken. lost: of pairs that miss frames, how many and why."""

    shot: Shot
    frames: int
    retaken: int
    lost: Mapping[str, str]


def capture_shot(devices: Devices, shot: Shot, progress: Progress = silent) -> Captured:
    """Take a shot by all pairs, and write it.

    A frame that is lost is taken again, twice; a pair that still misses one is named, and the file
    `done` says that no more will come. Raises OSError if a file cannot be written.
    """
    turns = plan_turns(devices.rig, devices.plan.order)
    total = sum(len(step) for turn in turns for step in turn)
    clock, rows = _Clock(), _read_other_rows(shot)
    lost: dict[Frame, str] = {}
    retaken = done = 0
    with background() as writer:
        written: list[Future[None]] = []
        for turn in turns:
            progress("capture", done, total)
            taken, missing, again = take_turn(devices, turn, shot)
            lost, retaken = lost | missing, retaken + again
            if turn is turns[0]:
                # Not before: whoever watches the folder waits for images only so long.
                _describe(devices, shot)
            # A pair has all its times or none: without some of its frames it is not decoded anyway.
            broken = {pair for pair, _ in missing}
            rows += clock.rows(shot.name, {k: p for k, p in taken.items() if k[0] not in broken})
            written.append(writer.submit(_write_turn, devices, shot, tuple(rows), taken))
            done += sum(map(len, turn))
        progress("capture", done, total)
        for one in written:
            one.result()
    if lost:
        write_text(shot.folder / "done", "")
    return Captured(shot, total - len(lost), retaken, _describe_lost(lost))


def refuse_existing_shot(rig: Rig, shot: Shot, overwrite: bool = False) -> None:
    """Raise CaptureError if the folder holds the shot already, or captures of the other kind; and
    BadInput for a name that no pseudonym or shot may have."""
    try:
        ShotEntry(name=shot.name)
        CapturesFile(kind=shot.kind, subject=shot.subject)
    except ValidationError as refused:
        raise BadInput(describe_first_error(refused), where=str(shot.folder)) from None
    if not (shot.folder / FILE_NAME).exists():
        return
    there = load_captures_file(shot.folder, rig)
    if there.kind != shot.kind:
        what = f"holds captures of kind {there.kind} already"
        raise CaptureError(what, where=str(shot.folder), remedy="give another --out")
    if shot.name in {one.name for one in there.shots or ()} and not overwrite:
        raise CaptureError(
            f"holds shot {shot.name} already",
            where=str(shot.folder),
            remedy="give another --out (of a board: another name), or --overwrite to take it again",
        )


def list_frames(rig: Rig, pair: Pair) -> tuple[str, ...]:
    """Names of a pair's frames in the order in which they are shown."""
    code, names = pair.projector, rig.frames
    if code is None:
        return names.sequence_names(None)
    dark = names.dark if any(one.uses_dark for one in code.directions) else None
    return (*filter(None, (names.board, names.lit, dark)), *names.shown_names(code))


def plan_turns(rig: Rig, order: Order) -> tuple[Turn, ...]:
    """The turns of a shot, by `CapturePlan.order`.

    poles: the k-th pairs of all poles project at the same time; a pair without a pole is treated as
    a pole with one pair. interleaved: one turn; frame k of every pair in succession.
    """
    frames = {pair.name: list_frames(rig, pair) for pair in rig.pairs}
    if order == "one-after-another":
        groups = [[name] for name in frames]
    elif order == "interleaved":
        groups = [list(frames)]
    else:
        poles: dict[str, list[str]] = {}
        for pair in rig.pairs:
            poles.setdefault(pair.pole or f"/{pair.name}", []).append(pair.name)
        groups = [list(filter(None, group)) for group in zip_longest(*poles.values())]
    turns = []
    for group in groups:
        rounds = zip_longest(*([(name, frame) for frame in frames[name]] for name in group))
        steps = [tuple(filter(None, one)) for one in rounds]
        if order == "interleaved":
            steps = [(each,) for step in steps for each in step]
        turns.append(tuple(steps))
    return tuple(turns)


def take_turn(
    devices: Devices, turn: Turn, shot: Shot
) -> tuple[dict[Frame, Picture], dict[Frame, str], int]:
    """Take a turn: its pictures, why others are missing after three attempts, and how many were
    taken again.

    Where a projector shows its frames in their order only, the whole turn is taken again.
    """
    pairs = {pair for step in turn for pair, _ in step}
    any_order = all(devices.projectors[p].any_order for p in pairs & devices.projectors.keys())
    taken: dict[Frame, Picture] = {}
    lost: dict[Frame, str] = {}
    todo, again = list(turn), 0
    for attempt in range(3):
        if attempt == 0 or not any_order:
            _begin(devices, turn, shot.name)
        found, lost = _take_steps(devices, todo, shot.timeout_s)
        taken |= found
        if not lost:
            break
        if any_order:
            todo = [tuple(one for one in step if one in lost) for step in turn]
            todo = [step for step in todo if step]
        again += sum(map(len, todo)) if attempt < 2 else 0
    return {key: taken[key] for key in taken.keys() - lost.keys()}, lost, again


def _begin(devices: Devices, turn: Turn, shot: str) -> None:
    for pair in dict.fromkeys(pair for step in turn for pair, _ in step):
        frames = [frame for step in turn for name, frame in step if name == pair]
        devices.cameras[pair].begin(shot, frames)
        if pair in devices.projectors:
            devices.projectors[pair].begin(frames)


def _take_steps(
    devices: Devices, steps: Sequence[Step], timeout_s: float
) -> tuple[dict[Frame, Picture], dict[Frame, str]]:
    """Show and photograph steps; pictures, and why others are missing."""
    taken: dict[Frame, Picture] = {}
    lost: dict[Frame, str] = {}
    for step, following in zip(steps, [*steps[1:], ()], strict=True):
        showing = [(devices.projectors[p], f) for p, f in step if p in devices.projectors]
        for projector, frame in showing:
            projector.show(frame)
        time.sleep(max((one.delay_ms or 0.0 for one, _ in showing), default=0.0) / 1000.0)
        waiting = []
        for pair, frame in step:
            try:
                devices.cameras[pair].trigger(frame)
                waiting.append((pair, frame))
            except FrameLost as error:
                lost[pair, frame] = str(error)
        for pair, frame in waiting:
            try:
                taken[pair, frame] = devices.cameras[pair].take(timeout_s)
            except FrameLost as error:
                lost[pair, frame] = str(error)
        for pair in {p for p, _ in step} - {p for p, _ in following}:
            if pair in devices.projectors:
                devices.projectors[pair].rest()
    return taken, lost


@dataclass
class _Clock:
    """Lays the clocks of cameras onto the host's.

    A picture arrives some time after it was taken, never before: of all pictures of a clock the one
    that came soonest tells how far that clock is ahead.
    """

    start_ms: float | None = None
    ahead_ms: dict[str, float] = field(default_factory=lambda: {HOST: 0.0})

    def rows(self, shot: str, taken: Mapping[Frame, Picture]) -> list[str]:
        """Rows of the file of times, by pair, in the order taken."""
        for clock in {picture.clock for picture in taken.values()} - self.ahead_ms.keys():
            late = [p.received_ms - p.began_ms for p in taken.values() if p.clock == clock]
            self.ahead_ms[clock] = min(late)
        middle = {
            key: p.began_ms + self.ahead_ms[p.clock] + 0.5 * p.exposure_ms
            for key, p in taken.items()
        }
        if self.start_ms is None:
            self.start_ms = min(
                (middle[key] - 0.5 * p.exposure_ms for key, p in taken.items()), default=None
            )
        start_ms = self.start_ms or 0.0
        ordered = sorted(middle, key=lambda key: (key[0], middle[key]))
        return [f"{shot},{p},{f},{max(middle[p, f] - start_ms, 0.0):.3f}" for p, f in ordered]


def _write_turn(
    devices: Devices, shot: Shot, rows: Sequence[str], taken: Mapping[Frame, Picture]
) -> None:
    if all(camera.has_clock for camera in devices.cameras.values()):
        write_text(shot.folder / TIMES, "\n".join([_HEADER, *rows, ""]))
    inbox, scan = shot.folder.parent, shot.folder.name
    for (pair, frame), picture in taken.items():
        put_image(inbox, devices.rig, scan, pair, frame, picture.image, shot=shot.name)


def _read_other_rows(shot: Shot) -> list[str]:
    """Rows of other shots in the folder's file of times."""
    with suppress(OSError):
        lines = (shot.folder / TIMES).read_text("utf-8").splitlines()[1:]
        return [line for line in lines if line.partition(",")[0] != shot.name]
    return []


def _describe(devices: Devices, shot: Shot) -> None:
    """Write captures.yaml, and an empty file of times: both are there before the first image."""
    shots: Iterable[ShotEntry] = ()
    if (shot.folder / FILE_NAME).exists():
        shots = load_captures_file(shot.folder, devices.rig).shots or ()
    striped = tuple(pair.name for pair in devices.rig.pairs if pair.projector)
    alone = tuple(pair.name for pair in devices.rig.pairs if not pair.projector)
    entry = ShotEntry(name=shot.name, stripes=striped or None, lit=alone or None)
    timed = all(camera.has_clock for camera in devices.cameras.values())
    described = CapturesFile(
        kind=shot.kind,
        when=datetime.now().replace(microsecond=0) if shot.kind == "scan" else None,
        subject=shot.subject,
        simulated=any(camera.is_simulated for camera in devices.cameras.values()) or None,
        shots=(*(one for one in shots if one.name != shot.name), entry),
        timing=Timing(times=TIMES) if timed else None,
    )
    if timed and not (shot.folder / TIMES).exists():
        write_text(shot.folder / TIMES, f"{_HEADER}\n")
    write_captures_file(shot.folder, described)


def _describe_lost(lost: Mapping[Frame, str]) -> dict[str, str]:
    """Why each pair misses frames, and how many."""
    counts = Counter(pair for pair, _ in lost)
    reasons = {pair: reason for (pair, _), reason in reversed([*lost.items()])}
    after = "frames are missing after three attempts"
    return {pair: f"{count} {after}: {reasons[pair]}" for pair, count in counts.items()}
