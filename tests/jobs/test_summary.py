"""The table of a day: what a person's sway is, and what the rig's drift."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from cheap_batch import jobs_of

from bodyscan.arrays import Array
from bodyscan.jobs.job import Job
from bodyscan.jobs.summary import (
    find_drift,
    scans_to_repeat,
    write_day_measures,
    write_summary,
)
from bodyscan.jobs.supervision import JobResult
from bodyscan.measurement.named import read_definitions
from bodyscan.report.measurement_table import named_csv
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
    assert scans_to_repeat(jobs) == ["s3"]
    for job in jobs[:2]:
        (job.folder / "measures").mkdir()
        text = named_csv("nobody stands there", {"subject": None})
        (job.folder / "measures" / "measures.csv").write_text(text, "utf-8")
    write_day_measures(jobs, out)
    measures = list(csv.DictReader((out / "measures.csv").open(newline="", encoding="utf-8")))
    assert len(measures) == 2 * len(read_definitions())
    assert {row["subject"] for row in measures} == {job.subject for job in jobs[:2]}
    assert {(row["value"], row["reason"]) for row in measures} == {("", "nobody stands there")}


def test_a_pair_that_all_scans_move_alike_is_told_from_one_that_sways(
    day: tuple[list[Job], Path],
) -> None:
    """b by 3 mm on the mean of five scans; a sways by 0.5 mm along each axis."""
    jobs, _ = day
    assert [one.pair for one in find_drift(jobs[4:])] == ["b"]
    assert find_drift(jobs[:2]) == []
