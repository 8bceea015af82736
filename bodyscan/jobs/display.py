"""How a batch is shown: bars for people, one JSON object per line for other programs."""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn
from rich.text import Text

from bodyscan.jobs.supervision import Listen
from bodyscan.verdict import LEFT_OUT, MARKS


@contextmanager
def json_lines() -> Iterator[Listen]:
    """Print every event as a line of JSON on standard output, with the time (seconds since 1970)."""
    lock = threading.Lock()

    def listen(event: dict[str, Any]) -> None:
        # A reader that has gone away is no reason to stop.
        with lock, suppress(BrokenPipeError):
            sys.stdout.write(json.dumps({"time": round(time.time(), 3), **event}) + "\n")
            sys.stdout.flush()

    yield listen


@contextmanager
def silence() -> Iterator[Listen]:
    """Show nothing; only errors are reported."""
    yield lambda event: None


@contextmanager
def screen() -> Iterator[Listen]:
    """Show one bar for all jobs with the time left, and a line for each that runs or has ended."""
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(bar_width=20),
        MofNCompleteColumn(),
        TextColumn("{task.fields[more]}", markup=False),
    )
    with Progress(*columns, console=Console(stderr=True)) as bars:
        yield _Screen(bars)


@contextmanager
def lines() -> Iterator[Listen]:
    """Print a line per scan as soon as its points are judged, one for its verdict, and one
    when its job has ended."""
    console = Console()

    def listen(event: dict[str, Any]) -> None:
        if event["event"] == "verdict":
            console.print(_verdict_text(event), soft_wrap=True)
        elif "kept" in event:
            console.print(_kept_text(event), soft_wrap=True)
        elif event["event"] == "job" and event["state"] in ("done", "set aside"):
            style = "dim" if event["state"] == "done" else "red"
            console.print(Text(ending(event), style=style), soft_wrap=True)

    yield listen


class _Screen:
    """Draws events, which come from several threads."""

    def __init__(self, bars: Progress) -> None:
        self._bars = bars
        self._lock = threading.Lock()
        self._running: dict[str, TaskID] = {}
        self._all: TaskID | None = None

    def __call__(self, event: dict[str, Any]) -> None:
        with self._lock:
            getattr(self, f"_{event['event']}")(event)

    def _batch(self, event: dict[str, Any]) -> None:
        self._all = self._bars.add_task("all jobs", total=len(event["jobs"]), more="")

    def _shares(self, event: dict[str, Any]) -> None:
        jobs = "job" if event["workers"] == 1 else "jobs"
        text = f"{event['workers']} {jobs} at a time, {event['threads']} threads each"
        self._bars.console.print(Text(f"{text} ({event['why']})", style="dim"), soft_wrap=True)

    def _summary(self, event: dict[str, Any]) -> None:
        aside = len(event["set_aside"])
        text = f"{event['done']} of {event['jobs']} jobs done ({event['ran']} of them now)"
        text += f", {aside} set aside" if aside else ""
        text += f"\nto be scanned again: {', '.join(event['repeat'])}" if event["repeat"] else ""
        text += _drift_text(event["drifted"])
        text += _stature_text(event["odd_stature_mm"])
        self._bars.console.print(Text(f"{text}\ntable: {event['table']}"), soft_wrap=True)

    def _progress(self, event: dict[str, Any]) -> None:
        if self._all is not None:
            more = f"about {_duration(event['seconds_left'])} left" if event["seconds_left"] else ""
            self._bars.update(self._all, completed=event["ended"], more=more)

    def _job(self, event: dict[str, Any]) -> None:
        job, state = event["job"], event["state"]
        if state in ("running", "sent"):
            more = f"attempt {event['attempt']}" if event.get("attempt", 1) > 1 else ""
            if job not in self._running:
                self._running[job] = self._bars.add_task(job, total=None, more=more)
            self._bars.update(self._running[job], more=more)
            return
        if job in self._running:
            self._bars.remove_task(self._running.pop(job))
        style = "" if state == "done" else "red"
        self._bars.console.print(Text(ending(event), style=style), soft_wrap=True)

    def _verdict(self, event: dict[str, Any]) -> None:
        if event["final"]:
            self._bars.console.print(_verdict_text(event), soft_wrap=True)

    def _stage(self, event: dict[str, Any]) -> None:
        if "kept" in event:
            self._bars.console.print(_kept_text(event), soft_wrap=True)
            return
        if event["job"] in self._running:
            self._bars.update(
                self._running[event["job"]],
                description=f"{event['job']}: {event.get('part', event['stage'])}",
                completed=event.get("done", 0),
                total=event.get("total"),
            )


def _verdict_text(event: dict[str, Any]) -> Text:
    """A scan's verdict with its worst reason, and every other pair that was lost."""
    grade = event["grade"] if event["final"] else f"{event['grade']} so far"
    text = ": ".join([event["job"], grade, *event["reasons"][:1]])
    others = [reason for reason in event["reasons"][1:] if reason.startswith(LEFT_OUT)]
    lost = ", ".join(reason.removeprefix(LEFT_OUT).partition(": ")[0] for reason in others)
    text += f"\n  also left out: {lost}" if lost else ""
    return Text(
        text,
        style={"good": "green", "usable": "yellow"}.get(MARKS.get(event["grade"], "bad"), "red"),
    )


def _kept_text(event: dict[str, Any]) -> Text:
    return Text(
        f"{event['job']}: files that were added to {event['stage']} are now in {event['kept']}"
    )


def ending(event: dict[str, Any]) -> str:
    """How a job ended, in one line (or more if it was set aside)."""
    if event["state"] != "done":
        tries = f" after {event['attempts']} attempts" if event["attempts"] else ""
        return f"{event['job']}: set aside{tries}: {event['reason']}"
    if not event["stages"]:
        return f"{event['job']}: up to date"
    return f"{event['job']}: {', '.join(event['stages'])} in {_duration(event['seconds'])}"


def _duration(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def _stature_text(median_mm: float | None) -> str:
    if median_mm is None:
        return ""
    return (
        f"\nthe median stature of these scans is {median_mm:.0f} mm, which no nation's adults have. "
        "Possible causes: they are children; square_mm is wrong in the rig file; the floor is not at "
        "z = 0"
    )


def _drift_text(drifted: dict[str, float]) -> str:
    """A warning of drift; drifted: mm, by pair."""
    if not drifted:
        return ""
    name, mm = next(iter(drifted.items()))
    more = f", and {len(drifted) - 1} more" if len(drifted) > 1 else ""
    return (
        f"\npair {name}{more}: alignment moves it by {mm:.1f} mm in the same direction in every scan, "
        "which sway does not explain: the rig has changed since the calibration, calibrate again"
    )
