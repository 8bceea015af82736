"""Start a job's process, listen to it, try once more, and then set the job aside."""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from subprocess import PIPE, Popen
from typing import Any, Protocol

from bodyscan.errors import escape_control
from bodyscan.files.atomic import write_json
from bodyscan.jobs.job import LOG, STATE, Job

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


class Process(Protocol):
    """Where jobs run: a process for each attempt, or one that stays (see watching)."""

    def attempt(self, job: Job, listen: Listen) -> tuple[str, tuple[str, ...]]:
        """Why the job failed, "" if it did not; and the stages that ran."""


def ignore_events(event: dict[str, Any]) -> None:
    """Ignore events, for callers that do not need them."""


def supervise_job(job: Job, process: Process, listen: Listen = ignore_events) -> JobResult:
    """Attempt a job in its folder, twice if necessary; return failures, never raise them."""
    path, since = job.folder, time.monotonic()
    stages: tuple[str, ...] = ()
    reason = ""
    for attempt in range(1, ATTEMPTS + 1):
        listen({"event": "job", "job": path.name, "state": "running", "attempt": attempt})
        _note_state(path, {"state": "running", "attempts": attempt, "reason": reason})
        reason, ran = process.attempt(job, listen)
        stages += ran
        if not reason:
            break
    state, seconds = "set aside" if reason else "done", round(time.monotonic() - since, 1)
    ran = tuple(dict.fromkeys(stages))
    outcome = JobResult(path.name, state, attempt, ran, seconds, reason)
    _note_state(path, asdict(outcome))
    return outcome


@dataclass(frozen=True)
class JobProcess:
    """A new process for each attempt."""

    threads: int  # of the libraries in it
    command: tuple[str, ...] = COMMAND  # arguments to this Python
    started: Callable[[Popen[str]], None] = lambda process: None  # called with each process

    def attempt(self, job: Job, listen: Listen) -> tuple[str, tuple[str, ...]]:
        """Why the job failed, "" if it did not; and the stages that ran."""
        folder = job.folder
        try:
            log = open_log(folder / LOG)
        except OSError as error:
            return f"its log cannot be written: {error.strerror}", ()
        with log:
            try:
                process = start_process((*self.command, str(folder)), self.threads, log)
            except OSError as error:
                return f"its process cannot be started: {error.strerror}", ()
            self.started(process)
            try:
                return listen_to(process, job, listen)
            finally:
                process.communicate()


def start_process(arguments: Sequence[str], threads: int, log: Any = None) -> Popen[str]:
    """Start this Python, which must end when its standard input closes.

    threads: of its libraries; BLAS gets one, since stages use the rest themselves.
    """
    return Popen(
        [sys.executable, *arguments],
        stdin=PIPE,
        stdout=PIPE,
        stderr=log,
        encoding="utf-8",
        errors="replace",
        env=os.environ
        | {
            "OMP_NUM_THREADS": str(threads),
            "OPENCV_FOR_THREADS_NUM": str(threads),
            "OPENBLAS_NUM_THREADS": "1",
            "MKL_NUM_THREADS": "1",
        },
        start_new_session=True,
    )


def listen_to(process: Popen[str], job: Job, listen: Listen) -> tuple[str, tuple[str, ...]]:
    """Pass on a process's messages until the job has ended, or the process; a stuck one is killed.

    Returns why the job failed, "" if it did not; and the stages that ran.
    """
    minutes, ran = job.pipeline.resources.limit_minutes, []
    stuck = threading.Timer(60.0 * minutes, process.kill)
    stuck.start()
    try:
        for message in read_messages(process):
            if "why" in message:
                ran.append(message["stage"])
            if "grade" in message:
                listen({"event": "verdict", "job": job.name, **message})
            if "cloud" in message:
                listen({"event": "cloud", "job": job.name, **message})
            if "stage" in message:
                listen({"event": "stage", "job": job.name, **message})
            if "ended" in message:
                return escape_control(message["failed"]), tuple(ran)
        status = process.wait()
        in_time = stuck.is_alive()
    finally:
        stuck.cancel()
    if in_time:
        return _describe_death(status, job.folder / LOG), tuple(ran)
    return f"was stopped: it took longer than {minutes:g} minutes", tuple(ran)


def read_messages(process: Popen[str]) -> Iterator[dict[str, Any]]:
    """The JSON objects that a process prints, one a line; whatever else it prints is left out."""
    assert process.stdout is not None
    for line in process.stdout:
        with suppress(ValueError):
            yield json.loads(line)


def _describe_death(status: int, log: Path) -> str:
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
            how += f"; the last line of its log: {escape_control(last)}"
    return how


def open_log(path: Path) -> Any:
    """Open a log to append to; never through a link, which might lead anywhere."""
    handle = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW, 0o600)
    stream = os.fdopen(handle, "ab", buffering=0)
    with suppress(OSError):
        stream.write(f"-- {time.strftime('%Y-%m-%dT%H:%M:%S%z')}\n".encode())
    return stream


def _note_state(folder: Path, state: dict[str, Any]) -> None:
    """Write state.json, for people and the next start; a full disk must not end the batch here."""
    with suppress(OSError):
        write_json(folder / STATE, state | {"when": time.strftime("%Y-%m-%dT%H:%M:%S%z")})
