"""Scans that arrive image by image at a rig's speed: how
long `watch` takes after the last image."""

from __future__ import annotations

import json
import os
import queue
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

PROJECT = Path(__file__).parents[1]
FRAME_S = 1.0 / 120.0
"""From one image to the next, pair after pair, as the simulated rigs take them."""
PATIENCE_S = 600.0


@dataclass(frozen=True)
class Answered:
    """Seconds from a scan's last image.

    verdict: to the first verdict, on its points.
    mesh: to the final verdict, with cloud and mesh stored.
    end: to the end of its job, with pictures, exports and report.
    """

    verdict: float
    mesh: float
    end: float


def answers(person: Path, calibration: Path, runs: int) -> list[Answered]:
    """Timings of `runs` arrivals of the same scan in one resident process, after a warm-up."""
    with tempfile.TemporaryDirectory(dir=person.parent.parent) as folder:
        inbox = Path(folder) / "inbox"
        inbox.mkdir()
        line = [sys.executable, "-m", "bodyscan", "watch", str(inbox), "--json"]
        line += ["--calibration", str(calibration), "--out", f"{folder}/out"]
        process = subprocess.Popen(line, stdout=subprocess.PIPE, text=True, cwd=PROJECT)
        assert process.stdout is not None
        events: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        threading.Thread(target=_read, args=(process.stdout, events), daemon=True).start()
        try:
            times = [_answered(person, inbox / f"scan-{k}", events) for k in range(runs + 1)]
        finally:
            process.terminate()
            process.wait()
    return times[1:]


def _answered(person: Path, arriving: Path, events: queue.SimpleQueue[dict[str, Any]]) -> Answered:
    _arrive(person, arriving)
    last, told = time.time(), dict[str, float]()
    while "end" not in told:
        event = events.get(timeout=PATIENCE_S)
        if event.get("job") != arriving.name:
            continue
        if event["event"] == "verdict":
            told["mesh" if event["final"] else "verdict"] = event["time"] - last
        elif event.get("state") == "set aside":
            raise SystemExit(f"watch set {arriving.name} aside: {event['reason']}")
        elif event.get("state") == "done":
            told["end"] = event["time"] - last
    return Answered(**told)


def _arrive(person: Path, arriving: Path) -> None:
    """Link the images one by one, pair after pair, after the files that describe them."""
    files = [path for path in person.rglob("*") if path.is_file()]
    files.sort(key=lambda path: (path.parent != person, path))
    for path in files:
        place = arriving / path.relative_to(person)
        place.parent.mkdir(parents=True, exist_ok=True)
        os.link(path, place)
        time.sleep(FRAME_S)


def _read(stream: IO[str], events: queue.SimpleQueue[dict[str, Any]]) -> None:
    for line in stream:
        events.put(json.loads(line))


if __name__ == "__main__":
    for answered in answers(Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3])):
        print(answered)
