"""When each frame was taken: `timing` in captures.yaml, and the file of times that it may name.

A time is the middle of a frame's exposure (of several exposures, the middle of all), in ms since
the first pair began with that shot.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Literal, TypeAlias

from pydantic import Field

from bodyscan.errors import CaptureError
from bodyscan.files.model import Model, Name, Problem, did_you_mean, duplicates
from bodyscan.files.model_file import report
from bodyscan.files.regular import read_regular
from bodyscan.files.yaml_file import Place, YamlProblem
from bodyscan.rig.rig import Rig
from bodyscan.rig.templates import path_fault

Sequences: TypeAlias = Mapping[tuple[str, str], tuple[str, ...]]
"""Names of the frames taken, by shot and pair, in the rig's order of pairs."""

FrameTimes: TypeAlias = Mapping[tuple[str, str], Mapping[str, float]]
"""Times in ms, by shot and pair, then by frame."""

LATEST_MS = 1e13
"""Upper limit of a time. Milliseconds since 1970 are 2e12, and are accepted."""
QUICKEST_MS, SLOWEST_MS = 0.01, 6e5
"""Limits of a frame's duration: a tenth of the quickest projectors', so that seconds are not
mistaken for ms; ten minutes."""
Milliseconds = Annotated[float, Field(ge=0.0, le=LATEST_MS)]
FrameMilliseconds = Annotated[float, Field(ge=QUICKEST_MS, le=SLOWEST_MS)]
Start = Literal["one-after-another", "together", "poles"] | dict[Name, Milliseconds]

COLUMNS = ("shot", "pair", "frame", "ms")
MOST_BYTES = 50_000_000
"""Enough for a million frames."""

_REMEDY = "Correct the file of times; docs/formats.md explains its columns."


class Timing(Model):
    """The key `timing`: a steady rate, or a file of times.

    frame_ms: from one frame to the next.
    order: names of frames in the order taken; None: as `FrameNames.of_sequence` lists them.
    start: when pairs begin in each shot; one-after-another: in the rig's order; together: all at
        once; poles: pairs of one pole one after another, all poles at once.
    times: a CSV file, relative to the capture folder.
    """

    frame_ms: FrameMilliseconds | None = None
    order: tuple[str, ...] | None = None
    start: Start | None = None
    times: str | None = None

    def problems(self) -> Iterator[Problem]:
        if self.times is None and self.frame_ms is None:
            yield ("frame_ms",), "is missing (or `times`, a file that has the time of each frame)"
        steady = {"frame_ms": self.frame_ms, "order": self.order, "start": self.start}
        for key in [key for key, value in steady.items() if value is not None and self.times]:
            yield (key,), "is said twice: `times` has the time of each frame"
        fault = path_fault(self.times) if self.times is not None else None
        if fault:
            yield ("times",), fault
        for index, name in duplicates(self.order or ()):
            yield ("order", index), f"lists a frame twice (got {name!r})"


def timing_problems(timing: Timing, rig: Rig) -> Iterator[Problem]:
    """Find what does not fit the rig: frames or pairs that
    it does not have, or that are left out."""
    known = [name for pair in rig.pairs for name in rig.frames.of_sequence(pair.projector)]
    order = known if timing.order is None else timing.order
    for index, name in enumerate(order):
        if name not in known:
            hint = did_you_mean(name, known)
            yield ("order", index), f"names no frame of rig {rig.name}{hint} (got {name!r})"
    left_out = [name for name in dict.fromkeys(known) if name not in order]
    if left_out:
        yield ("order",), f"leaves out {', '.join(left_out)}: every frame has its time"
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


def times_of_frames(timing: Timing, rig: Rig, sequences: Sequences, folder: Path) -> FrameTimes:
    """When every frame was taken. Raises CaptureError, with the line, for a wrong file of times."""
    if timing.times is not None:
        return _read_times(folder / timing.times, rig, sequences)
    found: dict[tuple[str, str], dict[str, float]] = {}
    for shot in dict.fromkeys(shot for shot, _ in sequences):
        taken = {pair: names for (one, pair), names in sequences.items() if one == shot}
        starts = _starts(timing, rig, {pair: len(names) for pair, names in taken.items()})
        for pair, names in taken.items():
            found[shot, pair] = _steady(timing, names, starts[pair])
    return found


def _steady(timing: Timing, names: Sequence[str], start: float) -> dict[str, float]:
    """Times of one pair's frames, in the order in which they were taken."""
    ordered = [name for name in timing.order if name in names] if timing.order else names
    step = timing.frame_ms or 0.0
    return {name: start + (place + 0.5) * step for place, name in enumerate(ordered)}


def _starts(timing: Timing, rig: Rig, counts: Mapping[str, int]) -> dict[str, float]:
    """When each pair began, ms, given how many frames each took."""
    if isinstance(timing.start, dict):
        return dict(timing.start)
    starts: dict[str, float] = {}
    over: dict[str | None, float] = {}  # when the pairs that took turns so far were done
    for pair, count in counts.items():
        pole = rig.pair(pair).pole or pair
        turn = {"together": pair, "poles": pole}.get(timing.start or "")
        starts[pair] = over.get(turn, 0.0)
        over[turn] = starts[pair] + count * (timing.frame_ms or 0.0)
    return starts


def _read_times(path: Path, rig: Rig, sequences: Sequences) -> FrameTimes:
    try:
        content = read_regular(path, MOST_BYTES)
        lines = content.decode("utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        what = f"the file of times cannot be read as text: {error}"
        raise CaptureError(what, where=str(path), remedy=_REMEDY) from None
    if len(content) > MOST_BYTES:
        what = f"is longer than {MOST_BYTES:,} bytes: this cannot be right"
        raise CaptureError(what, where=str(path), remedy=_REMEDY)
    found: dict[tuple[str, str], dict[str, float]] = {}
    problems = [
        YamlProblem(Place(line, 1), "", text) for line, text in _rows(lines, rig, sequences, found)
    ]
    for (shot, pair), frames in sequences.items():
        own = found.get((shot, pair), {})
        absent = [name for name in frames if own and name not in own]
        if absent:
            text = f"has no time of {', '.join(absent)} (pair {pair}, shot {shot})"
            problems.append(YamlProblem(Place(len(lines), 1), "", text))
    if problems:
        raise report(path, problems, CaptureError, _REMEDY)
    return found


def _rows(
    lines: Sequence[str],
    rig: Rig,
    sequences: Sequences,
    found: dict[tuple[str, str], dict[str, float]],
) -> Iterator[tuple[int, str]]:
    """Fill `found` from the rows of a file; yields line and words for what is wrong."""
    rows = csv.reader(lines)
    header = tuple(word.strip() for word in next(rows, []))
    if header != COLUMNS:
        yield (
            1,
            f"must begin with the line {','.join(COLUMNS)} (got {','.join(header) or 'nothing'})",
        )
        return
    shots = list(dict.fromkeys(shot for shot, _ in sequences))
    pairs = [pair.name for pair in rig.pairs]
    for row in rows:
        words = [word.strip() for word in row]
        if not any(words):
            continue
        fault = _row_fault(words, shots, pairs, sequences, found)
        if fault:
            yield rows.line_num, fault
        else:
            shot, pair, frame, ms = words
            found.setdefault((shot, pair), {})[frame] = float(ms)


def _row_fault(
    words: Sequence[str],
    shots: Sequence[str],
    pairs: Sequence[str],
    sequences: Sequences,
    found: Mapping[tuple[str, str], Mapping[str, float]],
) -> str | None:
    """What is wrong with one row, or None."""
    if len(words) != len(COLUMNS):
        return f"has {len(words)} columns, not {len(COLUMNS)}"
    shot, pair, frame, ms = words
    frames = sequences.get((shot, pair), ())
    for what, name, known in (("shot", shot, shots), ("pair", pair, pairs)):
        if name not in known:
            return f"names no {what} of these captures{did_you_mean(name, known)} (got {name!r})"
    if not frames:
        return f"pair {pair} took nothing in shot {shot}"
    if frame not in frames:
        hint = did_you_mean(frame, frames)
        return f"names no frame that pair {pair} took in shot {shot}{hint} (got {frame!r})"
    own = found.get((shot, pair), {})
    if frame in own:
        return f"gives frame {frame} of pair {pair} a second time"
    if not _is_time(ms):
        return f"ms must be a number, 0 or more (got {ms!r})"
    last = max(own, key=lambda name: own[name], default="")
    if own and float(ms) <= own[last]:
        return (
            f"time runs backwards: frame {frame} of pair {pair} at {ms} ms, after {last} at"
            f" {own[last]:g} ms (rows of a pair stand in the order in which it took its frames)"
        )
    return None


def _is_time(text: str) -> bool:
    try:
        value = float(text)
    except ValueError:
        return False
    return 0.0 <= value <= LATEST_MS
