"""captures.yaml: what a capture folder says about itself, and the file of times that it may name.

See docs/formats.md. A time is the middle of a frame's exposure (of several exposures, the middle of
all), in ms since the first pair began with that shot.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime
from functools import partial
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import Annotated, Literal, TypeAlias

from pydantic import Field

from bodyscan.errors import CaptureError
from bodyscan.files.atomic import write_text
from bodyscan.files.model import Model, Name, Problem, ShotName, did_you_mean, find_duplicates
from bodyscan.files.model_file import combine_problems, load_model
from bodyscan.files.reading import read_regular
from bodyscan.files.yaml_file import Place, YamlProblem, dump_yaml
from bodyscan.rig.rig import Rig
from bodyscan.rig.templates import find_path_fault

FILE_NAME = "captures.yaml"
_TIMES_REMEDY = "Correct the file of times (docs/formats.md), or give its own rig's calibration."

Sequences: TypeAlias = Mapping[tuple[str, str], tuple[str, ...]]
"""Names of the frames taken, by shot and pair, in the rig's order of pairs."""

FrameTimes: TypeAlias = Mapping[tuple[str, str], Mapping[str, float]]
"""Times in ms, by shot and pair, then by frame."""

# Milliseconds since 1970 are 2e12, and are accepted.
Milliseconds = Annotated[float, Field(ge=0.0, le=1e13)]
UNITS_MS = {"nanoseconds": 1e-6, "microseconds": 1e-3, "seconds": 1e3}
Start = Literal["one-after-another", "together", "poles"] | dict[Name, Milliseconds]

MAX_BYTES = 50_000_000  # of a file of times: a million frames


class Timing(Model):
    """The key `timing`: a steady rate, or a file of times.

    frame_ms: from one frame to the next.
    order: names of frames in the order taken; None: as `FrameNames.sequence_names` lists them.
    start: when pairs begin in each shot; one-after-another: in the rig's order; together: all at
        once; poles: pairs of one pole one after another, all poles at once.
    times: a CSV file, relative to the capture folder.
    """

    frame_ms: Annotated[float, Field(gt=0.0, le=1e13)] | None = None
    order: tuple[str, ...] | None = None
    start: Start | None = None
    times: str | None = None

    def problems(self) -> Iterator[Problem]:
        if self.times is None and self.frame_ms is None:
            yield ("frame_ms",), "is missing (or `times`, a file that has the time of each frame)"
        impossible = _step_fault(self.frame_ms) if self.frame_ms else ""
        if impossible:
            yield ("frame_ms",), impossible
        steady = {"frame_ms": self.frame_ms, "order": self.order, "start": self.start}
        for key in [key for key, value in steady.items() if value is not None and self.times]:
            yield (key,), "is said twice: `times` has the time of each frame"
        fault = find_path_fault(self.times) if self.times is not None else None
        if fault:
            yield ("times",), fault
        for index, name in find_duplicates(self.order or ()):
            yield ("order", index), f"lists a frame twice (got {name!r})"


class ShotEntry(Model):
    """One shot.

    stripes: the pairs that took the whole stripe sequence.
    lit: the pairs that took the lit image alone.

    If both are missing, the files in the folder decide.
    """

    name: ShotName
    stripes: tuple[Name, ...] | None = None
    lit: tuple[Name, ...] | None = None

    def problems(self) -> Iterator[Problem]:
        for index, name in find_duplicates(self.stripes or ()):
            yield ("stripes", index), f"lists a pair twice (got {name!r})"
        before = len(self.stripes or ())
        for index, name in find_duplicates((*(self.stripes or ()), *(self.lit or ()))):
            if index >= before:
                yield ("lit", index - before), f"lists a pair that is listed already (got {name!r})"


class CapturesFile(Model):
    """The whole captures.yaml.

    simulated: set by the simulator; reports repeat it.
    timing: when each frame was taken, if that is known.
    """

    version: Literal[1] = 1
    kind: Literal["calibration", "scan"]
    when: datetime | None = None
    subject: Name | None = None
    simulated: bool | None = None
    shots: tuple[ShotEntry, ...] | None = None
    timing: Timing | None = None

    def problems(self) -> Iterator[Problem]:
        if self.subject is not None and self.kind != "scan":
            yield ("subject",), "is for kind: scan"
        for index, name in find_duplicates(tuple(shot.name for shot in self.shots or ())):
            yield ("shots", index, "name"), f"is given to two shots (got {name!r})"


def load_captures_file(folder: Path, rig: Rig) -> CapturesFile:
    """Read the folder's captures.yaml and check it against the rig.

    Raises CaptureError, which lists every problem by line.
    """
    remedy = "Correct captures.yaml; docs/formats.md explains every key."
    also = partial(_find_unknown_names, rig=rig)
    return load_model(folder / FILE_NAME, CapturesFile, CaptureError, remedy=remedy, also=also)


def write_captures_file(folder: Path, captures: CapturesFile) -> None:
    """Write captures.yaml into a folder; `load_captures_file` reads back the same."""
    data = captures.model_dump(mode="json", exclude_none=True)
    write_text(folder / FILE_NAME, dump_yaml(data))


def _find_unknown_names(captures: CapturesFile, rig: Rig) -> Iterator[Problem]:
    pairs = {pair.name: pair for pair in rig.pairs}
    listed = [name for shot in captures.shots or () for name in shot.stripes or shot.lit or ()]
    if len(listed) > 1 and pairs.keys().isdisjoint(listed):
        text = f"is the calibration another rig's? Its pairs are {', '.join(pairs)}"
        yield ("shots",), f"{text} (got {', '.join(dict.fromkeys(listed))})"
        return
    for index, shot in enumerate(captures.shots or ()):
        for key in ("stripes", "lit"):
            for k, name in enumerate(getattr(shot, key) or ()):
                where = ("shots", index, key, k)
                if name not in pairs:
                    hint = did_you_mean(name, pairs)
                    yield where, f"names no pair of rig {rig.name}{hint} (got {name!r})"
                elif key == "stripes" and pairs[name].projector is None:
                    yield where, f"names a camera without projector (got {name!r}): list it in lit"
    if captures.timing:
        for inside, text in _find_timing_problems(captures.timing, rig):
            yield ("timing", *inside), text


def _find_timing_problems(timing: Timing, rig: Rig) -> Iterator[Problem]:
    """Find frames or pairs that the rig does not have, or that are left out."""
    known = [name for pair in rig.pairs for name in rig.frames.sequence_names(pair.projector)]
    order = known if timing.order is None else timing.order
    left_out = [name for name in dict.fromkeys(known) if name not in order]
    if left_out:
        other = ", or is the calibration another rig's?" if len(left_out) > 1 else ""
        yield ("order",), f"leaves out {', '.join(left_out)}: every frame has its time{other}"
    unknown = [(index, name) for index, name in enumerate(order) if name not in known]
    for index, name in unknown if min(len(left_out), len(unknown)) < 2 else ():
        hint = did_you_mean(name, known)
        yield ("order", index), f"names no frame of rig {rig.name}{hint} (got {name!r})"
    names = [pair.name for pair in rig.pairs]
    if timing.start is None and timing.times is None and len(names) > 1:
        yield ("start",), "is missing: one-after-another, together, poles, or ms by pair"
    if isinstance(timing.start, dict):
        for name in timing.start:
            if name not in names:
                hint = did_you_mean(name, names)
                yield ("start", name), f"names no pair of rig {rig.name}{hint}"
        absent = [name for name in names if name not in timing.start]
        if absent:
            yield ("start",), f"leaves out {', '.join(absent)}: every pair has its start"


def compute_frame_times(timing: Timing, rig: Rig, sequences: Sequences, folder: Path) -> FrameTimes:
    """Times in ms of the middle of each frame. Raises CaptureError, by line, for a wrong times file."""
    if timing.times is not None:
        return _read_times(folder / timing.times, rig, sequences)
    times: dict[tuple[str, str], dict[str, float]] = {}
    step = timing.frame_ms or 0.0
    for shot in dict.fromkeys(shot for shot, _ in sequences):
        taken = {pair: names for (one, pair), names in sequences.items() if one == shot}
        starts = _compute_starts(timing, rig, {pair: len(names) for pair, names in taken.items()})
        for pair, names in taken.items():
            ordered = [name for name in timing.order if name in names] if timing.order else names
            times[shot, pair] = {
                name: starts[pair] + (k + 0.5) * step for k, name in enumerate(ordered)
            }
    return times


def _step_fault(step_ms: float) -> str:
    """What is wrong with a time from frame to frame, naming the unit that would fit; "" if nothing."""
    low, high = 0.2, 2000.0  # half of the fastest projectors', twice as slow as anyone stands
    if low <= step_ms <= high:
        return ""
    unit = next((u for u, ms in UNITS_MS.items() if 1.0 <= ms * step_ms <= 1000.0), "")
    fits = f": are these {unit} ({UNITS_MS[unit] * step_ms:.4g} ms)? If not," if unit else ":"
    return (
        f"{step_ms:.6g} ms from frame to frame is not between {low:g} and {high:g}, which cameras and"
        f" people who stand can do{fits} leave `timing` out"
    )


def _compute_starts(timing: Timing, rig: Rig, counts: Mapping[str, int]) -> dict[str, float]:
    """Compute when each pair began, ms, from the number of frames that each took."""
    if isinstance(timing.start, dict):
        return dict(timing.start)
    starts: dict[str, float] = {}
    ended: dict[str | None, float] = {}  # when the pairs that take turns were done so far
    for pair, count in counts.items():
        pole = rig.pair(pair).pole or pair
        turn = {"together": pair, "poles": pole}.get(timing.start or "")
        starts[pair] = ended.get(turn, 0.0)
        ended[turn] = starts[pair] + count * (timing.frame_ms or 0.0)
    return starts


def _read_times(path: Path, rig: Rig, sequences: Sequences) -> FrameTimes:
    try:
        lines = read_regular(path, MAX_BYTES).decode("utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        what = f"the file of times cannot be read as text: {error}"
        raise CaptureError(what, where=str(path), remedy=_TIMES_REMEDY) from None
    found: dict[tuple[str, str], dict[str, float]] = {}
    problems = list(_parse_rows(lines, rig, sequences, found))
    for (shot, pair), frames in sequences.items():
        times = found.get((shot, pair), {})
        absent = [name for name in frames if times and name not in times]
        if absent:
            text = f"has no time of {', '.join(absent)} (pair {pair}, shot {shot})"
            problems.append(YamlProblem(Place(len(lines), 1), "", text))
    steps = [b - a for times in found.values() for a, b in pairwise(times.values())]
    fault = _step_fault(median(steps)) if steps else ""
    if fault:
        problems.append(YamlProblem(Place(1, 1), "", f"ms: {fault}"))
    if problems:
        raise combine_problems(path, problems, CaptureError, _TIMES_REMEDY)
    return found


def _parse_rows(
    lines: Sequence[str],
    rig: Rig,
    sequences: Sequences,
    found: dict[tuple[str, str], dict[str, float]],
) -> Iterator[YamlProblem]:
    """Parse rows into `found`; yields what is wrong."""
    rows, columns = csv.reader(lines), ["shot", "pair", "frame", "ms"]
    header = [word.strip() for word in next(rows, [])]
    if header != columns:
        got = ",".join(header) or "nothing"
        text = f"must begin with the line {','.join(columns)} (got {got})"
        yield YamlProblem(Place(1, 1), "", text)
        return
    for row in rows:
        words = [word.strip() for word in row]
        if not any(words):
            continue
        fault = _find_row_fault(words, rig, sequences, found)
        if fault:
            yield YamlProblem(Place(rows.line_num, 1), "", fault)
        else:
            shot, pair, frame, ms = words
            found.setdefault((shot, pair), {})[frame] = float(ms)


def _find_row_fault(
    words: Sequence[str],
    rig: Rig,
    sequences: Sequences,
    found: Mapping[tuple[str, str], Mapping[str, float]],
) -> str | None:
    """Return what is wrong with one row, or None."""
    if len(words) != 4:
        return f"has {len(words)} columns, not 4"
    shot, pair, frame, ms = words
    shots, frames = dict.fromkeys(shot for shot, _ in sequences), sequences.get((shot, pair), ())
    for what, name, known in (("shot", shot, shots), ("pair", pair, [p.name for p in rig.pairs])):
        if name not in known:
            return f"names no {what} of these captures{did_you_mean(name, known)} (got {name!r})"
    if frame not in frames:
        hint = did_you_mean(frame, frames)
        return f"names no frame that pair {pair} took in shot {shot}{hint} (got {frame!r})"
    times = found.get((shot, pair), {})
    if frame in times:
        return f"gives frame {frame} of pair {pair} a second time"
    try:
        time_ms = float(ms)
    except ValueError:
        time_ms = math.nan
    if not 0.0 <= time_ms <= 1e13:
        return f"ms must be a number, 0 or more (got {ms!r})"
    last = max(times, key=lambda name: times[name], default="")
    if times and time_ms <= times[last]:
        return (
            f"time runs backwards: frame {frame} of pair {pair} at {ms} ms, after {last} at"
            f" {times[last]:g} ms (rows of a pair are in the order in which it took its frames)"
        )
    return None
