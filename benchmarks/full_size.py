"""Rigs at full size: simulated, calibrated, a subject
scanned, everything compared with the truth."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.people import of_arms
from bodyscan.evaluation.surface import compute_signed_distances, fit_to_surface
from bodyscan.fusion.storage import load_scan
from bodyscan.geometry.robust import rms
from bodyscan.simulation.living import load_moving_body

PROJECT = Path(__file__).parents[1]
WORKSPACE = PROJECT / "bench" / "three-pole-12"
STANDING = {
    "three-pole-12": ("standing", "woman_average"),
    "four-pole-16": ("standing-four", "man_average"),
}
"""By rig: the folder and the subject of a scan of a person who stands."""


def three_pole() -> str:
    """The section of docs/results.md on three poles, twelve pairs and the woman."""
    return _report("Three poles, twelve pairs", "three-pole-12", "woman_average")


def four_pole() -> str:
    """The section of docs/results.md on four poles, sixteen pairs and the man."""
    return _report("Four poles, sixteen pairs", "four-pole-16", "man_average")


def living() -> str:
    """The section of docs/results.md on people who stand as people do, in the rigs calibrated by
    `three_pole` and `four_pole`."""
    scenes = [_stood(rig, *scene) for rig, scene in STANDING.items()]
    return f"""## People who sway, breathe and move their arms, full size (synthetic)

The woman in the rig of `three-pole-12` and the man in that of `four-pole-16`, calibrated there, pairs
one after the other (`bodyscan simulate --subject-preset standing`). Distances are to the body at the
moment that the scan stands for.

{chr(10).join(scenes)}"""


def _stood(rig: str, folder: str, subject: str) -> str:
    workspace = PROJECT / "bench" / folder
    commands = _commands(PROJECT / "rigs" / f"{rig}.yaml", workspace, _subject(subject))
    commands["simulate"] += ["--subject-preset", "standing", "--board-shots", 0]
    del commands["calibrate-rig"], commands["export"]
    shutil.rmtree(workspace / "calibration", ignore_errors=True)
    shutil.copytree(PROJECT / "bench" / rig / "calibration", workspace / "calibration")
    outputs, _, _ = run_commands(commands, workspace)
    return f"""| `{rig}`, `{subject}` | |
|---|---|
{_against_truth(outputs)}
{_by_parts(workspace)}

```
{outputs["scan"].strip()}
```
"""


def _by_parts(workspace: Path) -> str:
    stored, body = load_scan(workspace / "scan"), load_moving_body(workspace / "truth")
    assert body
    surface = body.vertices(stored.facts["person"]["moment_ms"]), np.asarray(body.rest.triangles)
    points = fit_to_surface(stored.cloud.points, *surface).apply(stored.cloud.points)
    errors, arms = compute_signed_distances(points, *surface), of_arms(points, surface[0], body)
    return (
        f"| of the cloud | arms RMS {rms(errors[arms]):.3f}, trunk, legs and head "
        f"{rms(errors[~arms]):.3f} mm |"
    )


def _report(title: str, rig: str, subject: str) -> str:
    workspace = PROJECT / "bench" / rig
    commands = _commands(PROJECT / "rigs" / f"{rig}.yaml", workspace, _subject(subject))
    commands["simulate"] += ["--subject-preset", "mannequin"]  # people are in `living`
    outputs, seconds, memory = run_commands(commands, workspace)
    rows = "\n".join(f"| `{name}` | {seconds[name]:.1f} | {memory[name]:.1f} |" for name in outputs)
    return f"""## {title}, full size (synthetic)

`rigs/{rig}.yaml` with `{subject}` simulated at 1280 x 1024, 640 stripes, mirror projectors,
the preset `workshop`, then the commands a user would type. Seconds of wall clock and peak
memory of each:

| command | s | GiB |
|---|---|---|
{rows}

| against the truth (synthetic) | |
|---|---|
{_against_truth(outputs)}

Calibration:

```
{outputs["calibrate-rig"].strip()}
```

Scan:

```
{outputs["scan"].strip()}
```
"""


def _subject(name: str) -> Path:
    return PROJECT / "data" / "subjects" / f"{name}.ply"


def _against_truth(outputs: dict[str, str]) -> str:
    """The rows of a table from the figures that `evaluate` printed."""
    found = re.search(r"against the truth[^\n]*\n(.*?)(?=results:)", outputs["evaluate"], re.DOTALL)
    lines = found.group(1).splitlines() if found else []
    # A name and its figures stand two spaces or more apart, or have a colon between them.
    cells = [re.split(r"\s{2,}|: ", line.strip(), maxsplit=1) for line in lines if line.strip()]
    return "\n".join(f"| {one[0]} | {' '.join(one[1:])} |" for one in cells)


def _commands(rig: Path, workspace: Path, subject: Path) -> dict[str, list[object]]:
    """The arguments that a user would type, in order."""
    result = workspace / "scan"
    person, calibration = workspace / "captures" / "person", workspace / "calibration"
    return {
        "simulate": [rig, "--out", workspace, "--subject", subject],
        "calibrate-rig": [workspace / "rig.yaml", "--overwrite"],
        "scan": [person, "--calibration", calibration, "--out", result, "--overwrite"],
        "export": [result, "--out", workspace / "export"],
        "evaluate": [workspace],
    }


def run_commands(
    commands: dict[str, list[object]], workspace: Path
) -> tuple[dict[str, str], dict[str, float], dict[str, float]]:
    """Output of each command, its duration (s), and its peak memory (GiB)."""
    outputs, seconds, memory = {}, {}, {}
    for name, arguments in commands.items():
        if name == "simulate" and (workspace / "truth" / "truth.json").exists():
            continue  # the same rig gives the same bytes
        started = time.perf_counter()
        outputs[name], memory[name] = _run([name, *map(_from_project, arguments), "--verbose"])
        seconds[name] = time.perf_counter() - started
    return outputs, seconds, memory


def _from_project(argument: object) -> str:
    """An argument with paths relative to the project, so that no folder of this machine is
    printed."""
    if isinstance(argument, Path) and argument.is_relative_to(PROJECT):
        return str(argument.relative_to(PROJECT))
    return str(argument)


def _run(arguments: list[str]) -> tuple[str, float]:
    """Output of a bodyscan command, and the peak memory (GiB) of its own process."""
    with tempfile.TemporaryFile("w+") as printed:
        line = [sys.executable, "-m", "bodyscan", *arguments]
        wide = {**os.environ, "COLUMNS": "150"}  # one row per pair
        process = subprocess.Popen(
            line, stdout=printed, stderr=subprocess.PIPE, text=True, cwd=PROJECT, env=wide
        )
        assert process.stderr is not None
        complaints = process.stderr.read()
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        printed.seek(0)
        output = printed.read()
    if process.returncode:
        raise SystemExit(f"{' '.join(line)} failed:\n{output}\n{complaints}")
    return output, usage.ru_maxrss / 2**20
