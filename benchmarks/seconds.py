"""What a user waits for: a cold command, a job of a batch, a warm scan; compared with image
reading."""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from benchmarks import full_size
from benchmarks.arrivals import answers

RUNS = 5
PROJECT = Path(__file__).parents[1]


def report(workspace: Path | None = None) -> str:
    """The section of docs/results.md; the workspace is `full_size`, simulated and calibrated."""
    workspace = workspace or Path(os.environ.get("BODYSCAN_BENCH", full_size.WORKSPACE))
    person, calibration = workspace / "captures" / "person", workspace / "calibration"
    reading = _in_process(workspace, "opencv")
    own = _in_process(workspace, "read")
    warm = _in_process(workspace, "warm")
    with tempfile.TemporaryDirectory() as folder:
        at = ["--calibration", str(calibration)]
        cold = [
            _command(["scan", str(person), *at, "--out", f"{folder}/scan-{k}"]) for k in range(RUNS)
        ]
        jobs = _batch(person, calibration, Path(folder))
    arrived = answers(person, calibration, RUNS)
    yardstick, ours = statistics.median(reading), statistics.median(own)
    rows = "\n".join(
        _row(name, times, yardstick, ours)
        for name, times in {
            "OpenCV reads the images, two threads, warm": reading,
            "bodyscan reads the images, two threads, warm": own,
            "`bodyscan scan`, cold: from the command to its end": cold,
            "a job of `bodyscan batch`, one at a time (scan, export, report)": jobs,
            "`bodyscan.scan` in a warm process: cloud and mesh, nothing written": warm,
            "`bodyscan watch`: from the last image to the verdict": [a.verdict for a in arrived],
            "`bodyscan watch`: to the mesh, kept, and the final verdict": [a.mesh for a in arrived],
            "`bodyscan watch`: to the end of the job, exports and report": [a.end for a in arrived],
        }.items()
    )
    return f"""## Seconds

The person of `{workspace.name}`: 12 pairs, 22 images each, default settings. Seconds of wall clock
over {RUNS} runs each, one after the other; the first has a column of its own, since that is what one
has who starts it once. For `watch`, which stays, images arrive one by one, 120 a second and pair after
pair, after one scan that is not counted. Ratios are of medians to reading the same images, by OpenCV
and by our own reader, in the same run of this benchmark.

| | first | median | least | most | to OpenCV | to our reader |
|---|---|---|---|---|---|---|
{rows}
"""


def _row(name: str, times: Sequence[float], opencv: float, own: float) -> str:
    middle = statistics.median(times)
    cells = [f"{value:.2f}" for value in (times[0], middle, min(times), max(times))]
    return "| " + " | ".join([name, *cells, f"{middle / opencv:.1f}", f"{middle / own:.1f}"]) + " |"


def _command(arguments: list[str]) -> float:
    """Duration of a command, from its start in a new process."""
    started = time.perf_counter()
    line = [sys.executable, "-m", "bodyscan", *arguments, "--quiet"]
    done = subprocess.run(line, capture_output=True, text=True, cwd=PROJECT, check=False)
    if done.returncode:
        raise SystemExit(f"{' '.join(line)} failed:\n{done.stdout}\n{done.stderr}")
    return time.perf_counter() - started


def _batch(person: Path, calibration: Path, folder: Path) -> list[float]:
    """Duration of each job in a batch on the same scan, as its state says."""
    scans = folder / "scans"
    scans.mkdir()
    names = [f"scan-{k}" for k in range(RUNS)]
    for name in names:
        (scans / name).mkdir()
        for path in person.rglob("*"):
            if path.is_file():
                place = scans / name / path.relative_to(person)
                place.parent.mkdir(parents=True, exist_ok=True)
                os.link(path, place)
    at = ["--scans", str(scans), "--out", str(folder / "out"), "--calibration", str(calibration)]
    _command(["batch", str(PROJECT / "pipelines" / "fuse.yaml"), *at, "--workers", "1"])
    states = [
        json.loads((folder / "out" / name / "state.json").read_text("utf-8")) for name in names
    ]
    return [float(state["seconds"]) for state in states]


def _in_process(workspace: Path, what: str) -> list[float]:
    """Duration of each run of `what` in one new process; for a warm scan, without the first run."""
    line = [sys.executable, "-m", "benchmarks.seconds", what, str(workspace)]
    done = subprocess.run(line, capture_output=True, text=True, cwd=PROJECT, check=False)
    if done.returncode:
        raise SystemExit(f"{what} failed:\n{done.stdout}\n{done.stderr}")
    times: list[float] = json.loads(done.stdout.splitlines()[-1])
    return times


def _work(workspace: Path, what: str) -> Callable[[], Any]:
    import bodyscan
    from bodyscan.captures.folder import open_scan
    from bodyscan.captures.images import read_sequence
    from bodyscan.progress import map_threads

    calibration = bodyscan.load_calibration(workspace / "calibration")
    person = workspace / "captures" / "person"
    if what == "warm":
        return lambda: bodyscan.scan(person, calibration)
    captures = open_scan(calibration.rig, person)
    if what == "read":
        cameras = {pair.name: pair.camera for pair in calibration.rig.pairs}
        return lambda: map_threads(
            lambda own: read_sequence(own, cameras[own.pair], workers=1) and None,
            captures.sequences,
        )
    import cv2

    paths = [[str(path) for path in sequence.paths] for sequence in captures.sequences]
    return lambda: map_threads(
        lambda own: [cv2.imread(path, cv2.IMREAD_GRAYSCALE) for path in own] and None, paths
    )


def main(what: str, workspace: Path) -> None:
    """Time runs of `what`; the last line printed is a JSON list of seconds."""
    work = _work(workspace, what)
    if what == "warm":
        work()
    times = []
    for _ in range(RUNS):
        started = time.perf_counter()
        work()
        times.append(time.perf_counter() - started)
    print(json.dumps(times))


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))
