"""Start a job's process, listen to it, try once more, and then set the job aside."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from bodyscan.files.atomic import write_json
from bodyscan.jobs.job import LOG, STATE, Job, printable

Listen = Callable[[dict[str, Any]], None]

ATTEMPTS = 2
COMMAND = ("-m", "bodyscan.jobs")


@dataclass(frozen=True)
class JobResult:
    """How a job ended. state: done, or set aside for `reason`. stages: those that ran."""

    job: str
    state: str
    attempts: int = 0
    stages: tuple[str, ...] = ()
    seconds: float = 0.0
    reason: str = ""


@dataclass(frozen=True)
class JobProcess:
    """How a job's process is run.

    threads: of the libraries in it.
    command: arguments to this Python.
    """

    threads: int
    command: tuple[str, ...] = COMMAND


def ignore_events(event: dict[str, Any]) -> None:
    """Ignore events, for callers that do not need them."""


def supervise_job(job: Job, process: JobProcess, listen: Listen = ignore_events) -> JobResult:
    """Run a job's process in its folder, twice if necessary; return failures, never raise them."""
    path, since = job.folder, time.monotonic()
    stages: tuple[str, ...] = ()
    reason = ""
    for attempt in range(1, ATTEMPTS + 1):
        listen({"event": "job", "job": path.name, "state": "running", "attempt": attempt})
        note_state(path, {"state": "running", "attempts": attempt, "reason": reason})
        reason, ran = _attempt(job, process, listen)
        stages += ran
        if not reason:
            break
    outcome = JobResult(
        path.name,
        "set aside" if reason else "done",
        attempt,
        tuple(dict.fromkeys(stages)),
        round(time.monotonic() - since, 1),
        reason,
    )
    note_state(path, asdict(outcome))
    return outcome


def _attempt(job: Job, how: JobProcess, listen: Listen) -> tuple[str, tuple[str, ...]]:
    """Why it failed, "" if it did not; and the stages that ran."""
    folder, minutes = job.folder, job.pipeline.resources.limit_minutes
    try:
        log = open_log(folder / LOG)
    except OSError as error:
        return f"its log cannot be written: {error.strerror}", ()
    with log:
        try:
            process = subprocess.Popen(
                [sys.executable, *how.command, str(folder)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                env=environment(how.threads),
                start_new_session=True,
            )
        except OSError as error:
            return f"its process cannot be started: {error.strerror}", ()
        stuck = threading.Timer(60.0 * minutes, process.kill)
        stuck.start()
        try:
            reason, ran = _listen_to(process, folder.name, listen)
            status = process.wait()
        finally:
            in_time = stuck.is_alive()
            stuck.cancel()
            if process.stdin:
                process.stdin.close()
    if status == 0:
        return "", ran
    if reason:
        return reason, ran
    if not in_time:
        return f"was stopped: it took longer than {minutes:g} minutes", ran
    return describe_death(status, folder / LOG), ran


def _listen_to(
    process: subprocess.Popen[bytes], job: str, listen: Listen
) -> tuple[str, tuple[str, ...]]:
    """Pass on the process's messages; returns its reason for failing, if it gives one, and the
    stages that it ran."""
    reason, ran = "", []
    assert process.stdout is not None
    with process.stdout as stream:
        for line in stream:
            try:
                message = json.loads(line)
            except ValueError:
                continue
            if "failed" in message:
                reason = printable(message["failed"])
            if "why" in message:
                ran.append(message["stage"])
            if "grade" in message:
                listen({"event": "verdict", "job": job, **message})
            if "stage" in message:
                listen({"event": "stage", "job": job, **message})
    return reason, tuple(ran)


def describe_death(status: int, log: Path) -> str:
    """Describe how a process died without giving a reason: exit status, last line of its log."""
    how = f"its process ended with {status}"
    if status < 0:
        with suppress(ValueError):
            how = f"its process was ended by {signal.Signals(-status).name}"
        if -status == signal.SIGKILL:
            how += " (possibly out of memory)"
    with suppress(OSError), log.open("rb") as stream:
        stream.seek(max(0, stream.seek(0, os.SEEK_END) - 4000))
        lines = stream.read().decode("utf-8", "replace").split("\n")
        last = next((line for line in reversed(lines) if line.strip()), "")
        if last and not last.startswith("-- "):
            how += f"; the last line of its log: {printable(last)}"
    return how


def open_log(path: Path) -> Any:
    """Open a log to append to; never through a link, which might lead anywhere."""
    handle = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW, 0o600)
    stream = os.fdopen(handle, "ab", buffering=0)
    with suppress(OSError):
        stream.write(f"-- {time.strftime('%Y-%m-%dT%H:%M:%S%z')}\n".encode())
    return stream


def environment(threads: int) -> dict[str, str]:
    """Set the libraries' threads; BLAS gets one, since stages use the rest themselves."""
    return os.environ | {
        "OMP_NUM_THREADS": str(threads),
        "OPENCV_FOR_THREADS_NUM": str(threads),
        "OPENBLAS_NUM_THREADS": "1",
        "MKL_NUM_THREADS": "1",
    }


def note_state(folder: Path, state: dict[str, Any]) -> None:
    """Write state.json, for people and --explain; a full disk must not end the batch here."""
    with suppress(OSError):
        write_json(folder / STATE, state | {"when": time.strftime("%Y-%m-%dT%H:%M:%S%z")})
