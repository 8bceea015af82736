"""A day's table, a person's sway in it and the rig's drift; what is shown meanwhile."""

from __future__ import annotations

import csv
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cheap_batch import jobs_of

from bodyscan.arrays import Array
from bodyscan.jobs.display import print_json_lines, show_failures, show_on_screen
from bodyscan.jobs.job import Job
from bodyscan.jobs.summary import (
    find_drift,
    list_scans_to_repeat,
    write_day_measures,
    write_summary,
)
from bodyscan.jobs.supervision import JobResult
from bodyscan.measurement.named import read_definitions
from bodyscan.report.measurement_table import format_named_csv
from bodyscan.settings import BODY_CENTRE_MM

NAMES = [f"s{number}" for number in range(9)]


def placed(shift_mm: Array, turn_rad: float = 0.0) -> list[list[float]]:
    """(4, 4): a camera 1.5 m in front of the body, turned about the body's centre and shifted."""
    c, s = np.cos(turn_rad), np.sin(turn_rad)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    matrix = np.eye(4)
    matrix[:3, :3] = turn
    position = np.array([1500.0, 0.0, 900.0])
    matrix[:3, 3] = turn @ (position - BODY_CENTRE_MM) + BODY_CENTRE_MM + shift_mm
    return matrix.tolist()


@pytest.fixture
def day(make_scans: Callable[..., Path], tmp_path: Path) -> tuple[list[Job], Path]:
    """Nine scans: everybody sways by a millimetre; pair b moves away, 0.5 mm a scan."""
    scans = make_scans(**dict.fromkeys(NAMES, "nothing"))
    pairs = {pair: {"rig_from_camera": placed(np.zeros(3))} for pair in ("a", "b")}
    (scans / "calibration.json").write_text(json.dumps({"pairs": pairs}))
    jobs, rng = jobs_of(scans, tmp_path / "out"), np.random.default_rng(5)
    for number, job in enumerate(jobs):
        shifts = {"a": rng.normal(0, 0.5, 3), "b": rng.normal(0, 0.5, 3) + [0, 0.5 * number, 0]}
        facts = {
            "when": f"2026-11-21T{10 + number}:00:00",
            "counts": {"points": 10, "faces": 200, "filled_faces": 15, "filled_share": 0.075},
            "median_sigma_mm": 0.02,
            "measured": {"a": 9, "b": 0},
            "failed": {},
            "verdict": {"grade": "repeat" if number == 3 else "good", "reasons": ["moved, a lot"]},
            "alignment": {
                "rms_before_mm": 0.3,
                "rms_after_mm": 0.1,
                "motion_mm": {pair: float(np.linalg.norm(s)) for pair, s in shifts.items()},
                "refused": {},
                "rig_from_camera": {p: placed(s, 1e-3) for p, s in shifts.items()},
            },
        }
        (job.folder / "scan").mkdir(parents=True)
        (job.folder / "scan" / "scan.json").write_text(json.dumps(facts))
    return jobs, tmp_path / "out"


def rows(jobs: list[Job], out: Path) -> list[dict[str, str]]:
    path = write_summary(jobs, [JobResult(job.name, "done", 1) for job in jobs], out)
    with path.open(newline="", encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


def test_a_scan_has_a_row_of_figures(day: tuple[list[Job], Path]) -> None:
    jobs, out = day
    table = rows(jobs, out)
    assert float(table[0]["coverage_percent"]) == 92.5
    assert table[0]["pairs_measured"] == "1"
    assert table[3]["verdict_reasons"] == "moved, a lot"
    assert list_scans_to_repeat(jobs) == ["s3"]
    for job in jobs[:2]:
        (job.folder / "measures").mkdir()
        text = format_named_csv("nobody stands there", {"subject": None})
        (job.folder / "measures" / "measures.csv").write_text(text, "utf-8")
    write_day_measures(jobs, out)
    measures = list(csv.DictReader((out / "measures.csv").open(newline="", encoding="utf-8")))
    assert len(measures) == 2 * len(read_definitions())
    assert {row["subject"] for row in measures} == {job.subject for job in jobs[:2]}
    assert {(row["value"], row["reason"]) for row in measures} == {("", "nobody stands there")}


def test_a_pair_that_all_scans_move_alike_is_told_from_one_that_sways(
    day: tuple[list[Job], Path],
) -> None:
    jobs, _ = day  # b by 3 mm on the mean of five scans; a sways by 0.5 mm along each axis
    assert [one.pair for one in find_drift(jobs[4:])] == ["b"]
    assert find_drift(jobs[:2]) == []


EVENTS: list[dict[str, Any]] = [
    {"event": "shares", "workers": 2, "threads": 1, "why": "2 cores"},
    {"event": "batch", "jobs": ["[red]a", "b"]},
    {"event": "job", "job": "[red]a", "state": "running", "attempt": 1},
    {"event": "stage", "job": "[red]a", "stage": "scan", "why": "there is no result yet"},
    {"event": "stage", "job": "[red]a", "stage": "scan", "part": "merging", "done": 1, "total": 2},
    {"event": "job", "job": "b", "state": "sent"},
    {"event": "job", "job": "b", "state": "done", "attempts": 1, "stages": [], "seconds": 0.4,
     "reason": ""},
    {"event": "progress", "ended": 1, "jobs": 2},
    {"event": "job", "job": "[red]a", "state": "running", "attempt": 2},
    {"event": "job", "job": "[red]a", "state": "set aside", "attempts": 2, "stages": ["scan"],
     "seconds": 9.0, "reason": "[/bold] broken"},
    {"event": "summary", "jobs": 2, "done": 1, "ran": 0, "set_aside": ["[red]a"], "repeat": ["b"],
     "drifted": {"p1-4": 1.31, "p2-1": 0.9},
     "table": "out/summary.csv"},
]  # fmt: skip


def test_people_are_told_what_happened(capsys: pytest.CaptureFixture[str]) -> None:
    with show_on_screen() as listen:
        for event in EVENTS:
            listen(event)
    said = capsys.readouterr().err
    assert "b: up to date" in said
    assert "[red]a: set aside after 2 attempts: [/bold] broken" in said
    assert "1 of 2 jobs done (0 of them now), 1 set aside" in said
    assert "out/summary.csv" in said
    assert "pair p1-4, and 1 more: alignment moves it by 1.3 mm in the same direction" in said
    with show_failures() as listen:
        for event in EVENTS:
            listen(event)
    assert capsys.readouterr().err == "[red]a: set aside after 2 attempts: [/bold] broken\n"


def test_programs_are_told_in_json(capsys: pytest.CaptureFixture[str]) -> None:
    with print_json_lines() as listen:
        for event in EVENTS:
            listen(event)
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [{k: v for k, v in line.items() if k != "time"} for line in lines] == EVENTS


def test_a_reader_that_goes_away_stops_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    class Gone:
        def write(self, text: str) -> None:
            raise BrokenPipeError

    monkeypatch.setattr(sys, "stdout", Gone())
    with print_json_lines() as listen:
        listen(EVENTS[0])


@pytest.mark.parametrize(
    ("reasons", "said"),
    [
        (
            ["left out: p1-1, p1-2: lit.png: is no image", "left out: p2-3: dark.png: is missing"],
            "anna: usable: left out: p1-1, p1-2: lit.png: is no image\n  also left out: p2-3\n",
        ),
        (
            ["two bodies", "left out: p1-1: x: y", "cut off", "left out: p2-3: z"],
            "anna: usable: two bodies\n  also left out: p1-1, p2-3\n",
        ),
        (["two bodies", "cut off"], "anna: usable: two bodies\n"),
    ],
)
def test_a_verdict_names_every_pair_that_was_lost(
    reasons: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    event = {"event": "verdict", "job": "anna", "grade": "usable", "reasons": reasons}
    with show_on_screen() as listen:
        listen(event | {"final": True})
    told = capsys.readouterr()
    assert said in told.out + told.err
