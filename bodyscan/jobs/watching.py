"""Scans fused while they arrive: an inbox is polled, and one resident process does the work.

The jobs are those of a batch, with the same folders, stages, states and manifests, so that a batch
or `verify` accepts them as its own, and nothing is done twice.
"""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

from bodyscan.errors import BadInput, BodyscanError, FailedWork
from bodyscan.files.atomic import lock_file, restrict_to_owner
from bodyscan.jobs.batch import finish, sweep
from bodyscan.jobs.inbox import IncomingScan
from bodyscan.jobs.job import (
    BATCH_LOCK,
    LOG,
    RESULTS,
    STATE,
    Job,
    job_name,
    job_of,
    printable,
    read_record,
    write_job,
)
from bodyscan.jobs.pipeline import Pipeline
from bodyscan.jobs.stages import KINDS, rig_of
from bodyscan.jobs.supervision import (
    ATTEMPTS,
    COMMAND,
    JobResult,
    Listen,
    describe_death,
    environment,
    ignore_events,
    note_state,
)


@dataclass(frozen=True)
class Watched:
    """What is watched and what to do with it.

    quiet_s: a scan with missing images is taken as it is if nothing has arrived for this long.
    """

    inbox: Path
    out: Path
    calibration: Path
    pipeline: Pipeline
    quiet_s: float = 30.0
    command: Sequence[str] = COMMAND


def watch(
    watched: Watched, listen: Listen = ignore_events, *, once: bool = False
) -> dict[str, Any]:
    """Fuse every scan of the inbox as its images arrive, until interrupted, or, with `once`, until
    everything there is done. Returns the event that ends a batch.

    A job that fails twice is set aside with its reason, and the others go on. Raises BadInput if
    the inbox is not a folder, if a batch or another watch is working in `out`, or if the
    calibration is unusable.
    """
    if not watched.inbox.is_dir():
        raise BadInput("there is no such folder", where=str(watched.inbox), remedy="make it first")
    rig = rig_of(watched.calibration)
    with restrict_to_owner():
        watched.out.mkdir(parents=True, exist_ok=True)
        with lock_file(watched.out / BATCH_LOCK, wait=False):
            sweep(watched.out)
            watching = _Watching(watched, listen)
            try:
                watching.process.start()
                while True:
                    for folder in watching.folders():
                        scan = watching.scans.setdefault(folder, IncomingScan(folder, rig))
                        watching.look_at(scan)
                    watching.handle_messages()
                    if once and not watching.scans:
                        return watching.summary()
            finally:
                watching.process.stop()


@dataclass
class _Watching:
    """scans: not ended yet. running: jobs handed over, in order, each with its number of
    attempts."""

    watched: Watched
    listen: Listen
    scans: dict[Path, IncomingScan] = field(default_factory=dict)
    prepared: dict[Path, set[str]] = field(default_factory=dict)
    running: dict[Path, tuple[Job, int]] = field(default_factory=dict)
    stages: dict[Path, list[str]] = field(default_factory=dict)
    jobs: dict[Path, Job] = field(default_factory=dict)
    ended: dict[Path, JobResult] = field(default_factory=dict)
    started_s: float = 0.0
    is_ready: bool = False

    def __post_init__(self) -> None:
        watched = self.watched
        self.process = ResidentProcess(
            watched.calibration, watched.pipeline.resources.threads, watched.command
        )

    def folders(self) -> list[Path]:
        """Folders of scans that are not done: what an earlier watch or batch did stays done."""
        watched = self.watched
        found = []
        for path in sorted(watched.inbox.absolute().iterdir()):
            is_folder = path.is_dir() and path != watched.out.absolute()
            if path.name.startswith(".") or not is_folder or path in self.ended:
                continue
            if any((path / name).exists() for name in RESULTS):
                continue
            if path not in self.scans and (outcome := self._earlier(path)):
                self.jobs[path] = self._job(path)
                self.ended[path] = outcome
                continue
            found.append(path)
        return found

    def look_at(self, scan: IncomingScan) -> None:
        """Request decoding of what has arrived, and the job once everything has."""
        path = scan.folder
        if path in self.running:
            return
        arrival = scan.look(time.monotonic(), self.watched.quiet_s)
        known = self.prepared.setdefault(path, set())
        new = sorted(set(arrival.whole) - known)
        if new:
            known.update(new)
            self.process.send(folder=str(path), pairs=new)
        if arrival.complete:
            self._hand_over(path, attempt=1)

    def handle_messages(self) -> None:
        """Handle messages from the process; waits for them briefly."""
        for message in self.process.receive(0.1):
            if "unusable" in message:
                raise BadInput(message["unusable"])
            self.is_ready |= "ready" in message
            path = next(iter(self.running), None)
            if path is None:
                continue
            job, attempt = self.running[path]
            if "grade" in message:
                self.listen({"event": "verdict", "job": job.name, **message})
            if "why" in message:
                self.stages.setdefault(path, []).append(message["stage"])
            if "stage" in message:
                self.listen({"event": "stage", "job": job.name, **message})
            if "ended" in message:
                self._end(path, attempt, printable(message["failed"]))
        status = self.process.status()
        limit_s = 60.0 * self.watched.pipeline.resources.limit_minutes
        if status is None and self.running and time.monotonic() - self.started_s > limit_s:
            self.process.kill()
        elif status is not None:
            self._restart(status)

    def _restart(self, status: int) -> None:
        """Restart the process after it died, either of the running job, which is tried once more,
        or of an image; scans present are then decoded only by their jobs, which count how often
        they fail."""
        if not self.is_ready:
            raise FailedWork(
                f"the process that fuses scans does not start: exit status {status}",
                where=str(self.watched.calibration),
                remedy="run `bodyscan scan` on one of the scans for a full message",
            )
        self.is_ready = False
        for path in self.scans:
            self.prepared[path] = {pair.name for pair in self.scans[path].rig.pairs}
        waiting = list(self.running.items())
        self.running.clear()
        self.process.start()
        for number, (path, (job, attempt)) in enumerate(waiting):
            if number == 0:
                self.running[path] = (job, attempt)
                self._end(path, attempt, describe_death(status, job.folder / LOG))
            else:
                self._hand_over(path, attempt)

    def _hand_over(self, path: Path, attempt: int) -> None:
        job = self._job(path)
        try:
            write_job(job)
        except (BodyscanError, OSError) as error:
            self.running[path] = (job, ATTEMPTS)
            self._end(path, ATTEMPTS, str(error))
            return
        if not self.running:
            self.started_s = time.monotonic()
        self.running[path] = (job, attempt)
        note_state(job.folder, {"state": "running", "attempts": attempt, "reason": ""})
        self.listen({"event": "job", "job": job.name, "state": "running", "attempt": attempt})
        self.process.send(folder=str(job.folder))

    def _end(self, path: Path, attempt: int, reason: str) -> None:
        job, _ = self.running.pop(path)
        seconds = round(time.monotonic() - self.started_s, 1)
        self.started_s = time.monotonic()
        if reason and attempt < ATTEMPTS:
            self._hand_over(path, attempt + 1)
            return
        ran = tuple(dict.fromkeys(self.stages.pop(path, [])))
        state = "set aside" if reason else "done"
        outcome = JobResult(job.name, state, attempt, ran, seconds, reason)
        self.scans.pop(path, None)
        self.prepared.pop(path, None)
        self.jobs[path], self.ended[path] = job, outcome
        note_state(job.folder, asdict(outcome))
        self.listen({"event": "job", **asdict(outcome)})
        self.listen(self.summary())

    def summary(self) -> dict[str, Any]:
        """Rewrite the table and the manifest over all jobs."""
        if not self.ended:
            return {"event": "summary", "jobs": 0, "set_aside": [], "repeat": []}
        jobs = [self.jobs[path] for path in self.ended]
        return finish(jobs, list(self.ended.values()), self.watched.out)

    def _job(self, path: Path) -> Job:
        watched = self.watched
        last = KINDS["fuse"][-1].name
        return job_of(path, watched.pipeline, watched.out, watched.calibration.absolute(), last)

    def _earlier(self, path: Path) -> JobResult | None:
        """How the scan's job ended before this watch began, unless its folder has changed since."""
        folder = self.watched.out / job_name(path.name)
        state = read_record(folder / STATE)
        if state.get("state") not in ("done", "set aside"):
            return None
        since = (folder / STATE).stat().st_mtime_ns
        if any(p.stat().st_mtime_ns > since for p in (path, *path.iterdir())):
            return None
        names = ("job", "state", "attempts", "stages", "seconds", "reason")
        known = {name: state[name] for name in names if name in state}
        return JobResult(**{**known, "stages": tuple(known.get("stages", ()))})


class ResidentProcess:
    """The process that does the work, and its messages."""

    def __init__(self, calibration: Path, threads: int, command: Sequence[str]) -> None:
        self._line = [sys.executable, *command, "--resident", str(calibration)]
        self._threads = threads
        self._process: subprocess.Popen[str] | None = None
        self._messages: SimpleQueue[dict[str, Any]] = SimpleQueue()

    def start(self) -> None:
        self.stop()
        self._messages = SimpleQueue()
        self._process = subprocess.Popen(
            self._line,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=environment(self._threads),
            start_new_session=True,
        )
        threading.Thread(
            target=self._read, args=(self._process, self._messages), daemon=True
        ).start()

    def send(self, **request: Any) -> None:
        """Send a request; if the process has died, `status` notices."""
        assert self._process is not None
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(json.dumps(request) + "\n")
            self._process.stdin.flush()
        except OSError:
            pass

    def receive(self, wait_s: float) -> list[dict[str, Any]]:
        """Messages since the last call; waits this long for the first one."""
        found = []
        try:
            found.append(self._messages.get(timeout=wait_s))
            while True:
                found.append(self._messages.get_nowait())
        except Empty:
            return found

    def status(self) -> int | None:
        """Exit status; None while it runs, or while messages are left."""
        if self._process is None or not self._messages.empty():
            return None
        return self._process.poll()

    def kill(self) -> None:
        """Kill a process that is stuck; `status` then reports its end."""
        if self._process is not None:
            self._process.kill()

    def stop(self) -> None:
        self.kill()
        if self._process is not None:
            self._process.wait()
            self._process = None

    @staticmethod
    def _read(process: subprocess.Popen[str], messages: SimpleQueue[dict[str, Any]]) -> None:
        assert process.stdout is not None
        for line in process.stdout:
            try:
                messages.put(json.loads(line))
            except ValueError:
                continue
