"""A batch of cheap jobs, each in a process of its own, and what it left."""

from __future__ import annotations

import io
import json
import sys
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cheap_job

from bodyscan.errors import BodyscanError
from bodyscan.files.hashing import hash_file, list_files
from bodyscan.jobs.job import Job, find_jobs
from bodyscan.jobs.pipeline import load_pipeline


@dataclass(frozen=True)
class Done:
    """A batch that ended: its exit code, what it told, line by line, and its errors."""

    code: int
    events: list[dict[str, Any]]
    errors: str

    def endings(self) -> dict[str, dict[str, Any]]:
        """Of every job, how it ended."""
        ends = [e for e in self.events if e["event"] == "job" and "reason" in e]
        return {event["job"]: event for event in ends}


def write_scans(folder: Path, **todo: str) -> Path:
    """Scans in `folder`, which is returned: by a scan's name, what its stage is to do."""
    for name, what in todo.items():
        scan = folder / name
        scan.mkdir(parents=True)
        (scan / "do.txt").write_text(what)
        (scan / "image.txt").write_text(f"image of {name}")
    return folder


def batch_command(scans: Path, out: Path, workers: int = 2) -> list[str]:
    return [sys.executable, cheap_job.__file__, "batch", str(scans), str(out), str(workers)]


def run_cheap(scans: Path, out: Path, workers: int = 2) -> Done:
    """As `batch_command`, without the process around the jobs' own."""
    told, errors = io.StringIO(), ""
    try:
        with redirect_stdout(told):
            code = cheap_job.batch(scans, out, workers)
    except (BodyscanError, OSError) as error:
        code, errors = getattr(error, "exit_code", 1), str(error)
    return Done(code, [json.loads(line) for line in told.getvalue().splitlines()], errors)


def jobs_of(scans: Path, out: Path, *changes: str) -> list[Job]:
    pipeline = load_pipeline(cheap_job.PIPELINE, changes)
    return find_jobs(pipeline, scans, out, scans, "export")


def results(out: Path) -> dict[str, str]:
    """The hash of every result and manifest; states, logs and locks tell of times and attempts."""
    running = {"state.json", "log.txt", "lock", "batch.lock", "summary.csv", "job.json", "was here"}
    paths = [path for path in list_files(out) if path.name not in running]
    return {str(path.relative_to(out)): hash_file(path) for path in paths}
