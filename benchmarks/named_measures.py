"""Landmarks and measures by name on random bodies, against the same definitions on the true surface.

Needs `anny` and torch, as data/body/README.md says:

    PYTHONPATH=/tmp/anny/lib/python3.11/site-packages python -m benchmarks named-measures

Half of the bodies have surface that the template's shapes cannot make; other seeds than those that
the landmarks' sigmas were measured on. Synthetic agreement: the shapes are of the same population.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

import numpy as np

from benchmarks.cast_people import cast_person
from bodyscan.body_model.registered import register_body
from bodyscan.body_model.template import drop_side
from bodyscan.errors import BadInput
from bodyscan.measurement.named import Measure, NamedMeasures, measure_by_name, take_measures
from bodyscan.outcome import Outcome
from bodyscan.settings import ScanSettings
from bodyscan.workflows.scan_person import fuse

SEEDS, REPEATS = range(200, 240), range(51, 61)


@dataclass(frozen=True, eq=False)
class Trial:
    """One body's measures, found and true, and what they took; found is None if it was refused."""

    outside: bool
    found: NamedMeasures | None
    true: NamedMeasures | None
    cpu_s: float


def report(seeds: Sequence[int] = SEEDS) -> str:
    """The section of docs/results.md."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "data" / "body"))
    bodies = import_module("random_bodies")
    trials = []
    for body in bodies.make_bodies(seeds):
        mesh, start = bodies.scan_body(body), time.process_time()
        try:
            registered = register_body(mesh)
        except BadInput:
            trials.append(Trial(body.outside, None, None, 0.0))
            continue
        found, seconds = take_measures(registered), time.process_time() - start
        true = take_measures(bodies.lay_truth(body, registered))
        trials.append(Trial(body.outside, found, true, seconds))
    return write_section(trials) + "\n" + _repeat() + "\n"


def _repeat() -> str:
    """A sentence on ten scans of one person who stands, cast by rays (ten minutes)."""
    values: dict[str, list[float]] = {}
    for seed in REPEATS:
        cast = cast_person("three-pole-12", "woman_average", "standing", seed)
        scan = fuse(cast.calibration, Outcome(cast.images), ScanSettings())
        for name, one in measure_by_name(scan.mesh).measures.items():
            values.setdefault(name, []).append(one.mm)
    spread = {name: float(np.std(some, ddof=1)) for name, some in values.items()}
    worst = ", ".join(f"{name} {mm:.1f}" for name, mm in spread.items() if mm > 1.5) or "none"
    middle = np.median(list(spread.values()))
    return (
        "Ten scans of the demo's woman, `standing` in `three-pole-12`, cast by rays: standard"
        f" deviation {middle:.1f} mm in the median measure, above 1.5: {worst}."
    )


def write_section(trials: Sequence[Trial]) -> str:
    """A table of both halves of the bodies."""
    rows = [
        "## Measures by name on random bodies (synthetic agreement)",
        "",
        f"{len(trials)} bodies of MakeHuman's shapes in random poses, seen as by three-pole-12 "
        "(`benchmarks/named_measures.py`): against the same definitions on the true surface, mm.",
        "",
        "| bodies | landmarks: median, 95 % | girths: mean, 95 % | heights and lengths: mean, 95 % "
        "| intervals that hold | bust, waist, hip a number | refused | CPU s |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name, outside in (("within the shapes", False), ("outside of them", True)):
        rows.append(f"| {name} | {_summarize([t for t in trials if t.outside == outside])} |")
    rows += [
        "",
        "Both halves, by measure: error, half of the median interval, mm; truths inside, %; ranges.",
        "What is off by more than 8 mm in one case of twenty is called approximate.",
        "",
    ]
    rows += [
        "| measure | error: mean, 95 % | half interval | inside | ranges |",
        "|---|---|---|---|---|",
    ]
    return "\n".join(rows + _list_measures(trials)) + "\n"


def _list_measures(trials: Sequence[Trial]) -> list[str]:
    """A row of the table for each measure, of both sides together."""
    found: dict[str, list[tuple[float, float, bool, bool]]] = {}
    for trial in trials:
        if trial.found is None or trial.true is None:
            continue
        for name, one in trial.found.measures.items():
            if true := trial.true.measures.get(name):
                low, high = one.interval_mm
                cells = (
                    abs(one.mm - true.mm),
                    0.5 * (high - low),
                    low <= true.mm <= high,
                    one.is_range,
                )
                found.setdefault(drop_side(name), []).append(cells)
    rows = []
    for name, some in sorted(found.items()):
        error, half, inside, ranges = np.array(some, float).T
        worst = float(np.quantile(error, 0.95))
        missed = " (missed)" if worst > 8.0 and "approximate" not in name else ""
        rows.append(
            f"| {name} | {error.mean():.1f}, {worst:.1f}{missed} | {np.median(half):.1f} "
            f"| {100.0 * inside.mean():.0f} | {ranges.sum():.0f} of {len(some)} |"
        )
    return rows


def _summarize(trials: Sequence[Trial]) -> str:
    pairs = [(t.found, t.true) for t in trials if t.found is not None and t.true is not None]
    off = np.concatenate([_landmark_errors(found, true) for found, true in pairs])
    girths = np.concatenate([_errors(a.measures, b.measures, True) for a, b in pairs])
    lengths = np.concatenate([_errors(a.measures, b.measures, False) for a, b in pairs])
    held = [
        one.interval_mm[0] <= true.measures[name].mm <= one.interval_mm[1]
        for found, true in pairs
        for name, one in found.measures.items()
        if name in true.measures
    ]
    names = ("bust girth", "waist girth", "hip girth")
    sure = sum(all(not found.measures[name].is_range for name in names) for found, _ in pairs)
    seconds = np.median([t.cpu_s for t in trials if t.found is not None])
    return " | ".join((
        f"{np.median(off):.1f}, {np.quantile(off, 0.95):.1f}",
        f"{girths.mean():.1f}, {np.quantile(girths, 0.95):.1f}",
        f"{lengths.mean():.1f}, {np.quantile(lengths, 0.95):.1f}",
        f"{100.0 * np.mean(held):.0f} %",
        f"{sure} of {len(trials)}",
        str(len(trials) - len(pairs)),
        f"{seconds:.0f}",
    ))  # fmt: skip


def _landmark_errors(found: NamedMeasures, true: NamedMeasures) -> np.ndarray:
    """Distances (L,) mm of landmarks from the true ones."""
    names = sorted(found.landmarks)
    a, b = (np.array([named.landmarks[n].position_mm for n in names]) for named in (found, true))
    return np.asarray(np.linalg.norm(a - b, axis=1))


def _errors(found: Mapping[str, Measure], true: Mapping[str, Measure], girths: bool) -> np.ndarray:
    """Absolute errors (M,) mm of the girths, or of all others, that both have."""
    return np.array([
        abs(one.mm - true[name].mm)
        for name, one in found.items()
        if name in true and (one.kind == "girth") == girths
    ])  # fmt: skip
