"""The process that stays, seen from the one that started it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from bodyscan.errors import BadInput, FailedWork
from bodyscan.jobs.job import Job, job_of
from bodyscan.jobs.pipeline import Pipeline
from bodyscan.jobs.supervision import ignore_events
from bodyscan.jobs.watching import ResidentProcess, Watched
from bodyscan.settings import Resources

READY = 'print("{\\"ready\\": true}", flush=True)'


def resident(folder: Path, program: str) -> tuple[ResidentProcess, Job]:
    """A process that does what a program says, and a job for it that may take 1.5 s."""
    soon = Pipeline(name="watch", kind="fuse", resources=Resources(limit_minutes=0.025))
    watched = Watched(folder, folder, folder, soon, command=("-c", program))
    job = job_of(folder / "anna", soon, folder, folder, "scan")
    return ResidentProcess(watched), job


def test_a_job_at_which_the_process_is_stuck_is_ended(tmp_path: Path) -> None:
    """It is then tried again; were it not seen, watch would wait for it for ever."""
    process, job = resident(tmp_path, f"import time; {READY}; time.sleep(600)")
    process.start()
    try:
        reason, stages = process.attempt(job, ignore_events)
    finally:
        process.stop()
    assert reason == "was stopped: it took longer than 0.025 minutes"
    assert stages == ()


def test_a_process_that_died_is_started_again_for_the_next_job(tmp_path: Path) -> None:
    answer = json.dumps({"ended": "anna", "failed": ""})
    process, job = resident(tmp_path, f"{READY}; input(); print({answer!r}, flush=True); input()")
    slow = replace(job, pipeline=Pipeline(name="watch", kind="fuse"))
    process.start()
    try:
        assert process.attempt(slow, ignore_events)[0] == ""
        assert "ended with 0" in process.attempt(slow, ignore_events)[0]
        assert process.attempt(slow, ignore_events)[0] == ""
    finally:
        process.stop()
    with pytest.raises(FailedWork):
        process.start()


@pytest.mark.parametrize(
    ("program", "error"),
    [('print(\'{"unusable": "no file"}\')', BadInput), ("raise SystemExit(3)", FailedWork)],
)
def test_a_process_that_cannot_start_ends_the_watch(
    tmp_path: Path, program: str, error: type[Exception]
) -> None:
    process, _ = resident(tmp_path, program)
    with pytest.raises(error):
        process.start()
    process.stop()
