"""What is shown while a batch runs."""

from __future__ import annotations

import json
import sys
from typing import Any

import pytest

from bodyscan.jobs.display import print_json_lines, show_on_screen

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
    assert "to be scanned again: b" in said
    assert "out/summary.csv" in said
    assert "pair p1-4, and 1 more: alignment moves it by 1.3 mm in the same direction" in said


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
