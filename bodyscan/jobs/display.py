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
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeRemainingColumn,
)
from rich.text import Text

from bodyscan.jobs.supervision import Listen
from bodyscan.verdict import LEFT_OUT, MARKS, STYLES


@contextmanager
def print_json_lines() -> Iterator[Listen]:
    """Print every event as a line of JSON on standard output, with the time (seconds since 1970)."""
    lock = threading.Lock()

    def listen(event: dict[str, Any]) -> None:
        # A reader that has gone away is no reason to stop.
        with lock, suppress(BrokenPipeError):
            sys.stdout.write(json.dumps({"time": round(time.time(), 3), **event}) + "\n")
            sys.stdout.flush()

    yield listen


@contextmanager
def show_on_screen() -> Iterator[Listen]:
    """Show one bar for a batch with the time left, and a line for each job that runs or has ended.

    A watch has no such bar; instead a line for each scan as soon as its points are judged.
    """
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(bar_width=20),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[more]}", markup=False),
    )
    day_s = 24.0 * 3600.0  # jobs take minutes: the time left follows from all that ended
    with Progress(*columns, console=Console(stderr=True), speed_estimate_period=day_s) as bars:
        yield _Screen(bars)


@contextmanager
def show_failures() -> Iterator[Listen]:
    """Show on standard error only jobs that are set aside, and scans that are to be repeated."""
    console = Console(stderr=True)

    def listen(event: dict[str, Any]) -> None:
        match event:
            case {"event": "job", "state": "set aside"}:
                console.print(Text(format_ending(event)), soft_wrap=True)
            case {"event": "verdict", "final": True, "grade": "repeat"}:
                console.print(_format_verdict(event), soft_wrap=True)

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
            getattr(self, f"_show_{event['event']}")(event)

    def _print(self, text: str | Text, style: str = "") -> None:
        text = text if isinstance(text, Text) else Text(text, style)
        self._bars.console.print(text, soft_wrap=True)

    def _show_batch(self, event: dict[str, Any]) -> None:
        self._all = self._bars.add_task("all jobs", total=len(event["jobs"]), more="")

    def _show_shares(self, event: dict[str, Any]) -> None:
        jobs = "job" if event["workers"] == 1 else "jobs"
        text = f"{event['workers']} {jobs} at a time, {event['threads']} threads each"
        self._print(f"{text} ({event['why']})", "dim")

    def _show_summary(self, event: dict[str, Any]) -> None:
        if self._all is None:
            return
        aside = len(event["set_aside"])
        text = f"{event['done']} of {event['jobs']} jobs done ({event['ran']} of them now)"
        text += f", {aside} set aside" if aside else ""
        if event["drifted"]:
            name, mm = next(iter(event["drifted"].items()))  # the largest first
            more = f", and {len(event['drifted']) - 1} more" if len(event["drifted"]) > 1 else ""
            text += (
                f"\npair {name}{more}: alignment moves it by {mm:.1f} mm in the same direction in "
                "every scan, which sway does not explain: the rig has changed since the calibration, "
                "calibrate again"
            )
        self._print(f"{text}\ntable: {event['table']}")

    def _show_progress(self, event: dict[str, Any]) -> None:
        if self._all is not None:
            self._bars.update(self._all, completed=event["ended"])

    def _show_job(self, event: dict[str, Any]) -> None:
        job, state = event["job"], event["state"]
        if state in ("running", "sent"):
            more = f"attempt {event['attempt']}" if event.get("attempt", 1) > 1 else ""
            if job not in self._running:
                self._running[job] = self._bars.add_task(job, total=None, more=more)
            self._bars.update(self._running[job], more=more)
            return
        if job in self._running:
            self._bars.remove_task(self._running.pop(job))
        self._print(format_ending(event), "" if state == "done" else "red")

    def _show_verdict(self, event: dict[str, Any]) -> None:
        if event["final"] or self._all is None:
            self._print(_format_verdict(event))

    def _show_stage(self, event: dict[str, Any]) -> None:
        if "kept" in event:
            added = f"files that were added to {event['stage']} are now in {event['kept']}"
            self._print(f"{event['job']}: {added}")
        elif event["job"] in self._running:
            self._bars.update(
                self._running[event["job"]],
                description=f"{event['job']}: {event.get('part', event['stage'])}",
                completed=event.get("done", 0),
                total=event.get("total"),
            )


def _format_verdict(event: dict[str, Any]) -> Text:
    """A scan's verdict with its worst reason, and every other pair that was lost."""
    grade = event["grade"] if event["final"] else f"{event['grade']} so far"
    text = ": ".join([event["job"], grade, *event["reasons"][:1]])
    others = [reason for reason in event["reasons"][1:] if reason.startswith(LEFT_OUT)]
    lost = ", ".join(reason.removeprefix(LEFT_OUT).partition(": ")[0] for reason in others)
    text += f"\n  also left out: {lost}" if lost else ""
    return Text(text, STYLES[MARKS.get(event["grade"], "bad")])


def format_ending(event: dict[str, Any]) -> str:
    """How a job ended, in one line (or more if it was set aside)."""
    if event["state"] != "done":
        tries = f" after {event['attempts']} attempts" if event["attempts"] else ""
        return f"{event['job']}: set aside{tries}: {event['reason']}"
    if not event["stages"]:
        return f"{event['job']}: up to date"
    return f"{event['job']}: {', '.join(event['stages'])} in {_format_duration(event['seconds'])}"


def _format_duration(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
