"""Scans fused while they arrive: an inbox is polled, and one resident process does the work.

An inbox has one folder per scan. An image is whole if it ends as its format does, or has not changed
for a while; a pair if all its images are; a scan is complete if all pairs are whole, or `done` is in
its folder, or nothing has arrived for long. docs/station.md is the protocol.

The jobs are those of a batch, with the same folders, stages, states and manifests, so that a batch
or `verify` accepts them as its own, and nothing is done twice.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from subprocess import Popen
from threading import Event
from typing import Any

import cv2

from bodyscan.arrays import Bytes
from bodyscan.captures.captures_file import FILE_NAME as CAPTURES
from bodyscan.captures.folder import ImageSequence, open_scan
from bodyscan.errors import BadInput, CaptureError, FailedWork
from bodyscan.files.atomic import write_bytes
from bodyscan.files.hashing import list_files
from bodyscan.jobs.batch import finish, hold_output, write_or_refuse
from bodyscan.jobs.job import (
    RESULTS,
    STAGE,
    STATE,
    Job,
    list_results_in,
    make_job,
    make_job_name,
    read_record,
)
from bodyscan.jobs.pipeline import Pipeline
from bodyscan.jobs.stages import KINDS, read_rig_of
from bodyscan.jobs.supervision import (
    COMMAND,
    JobProcess,
    JobResult,
    Listen,
    ignore_events,
    listen_to,
    read_messages,
    start_process,
    supervise_job,
)
from bodyscan.rig.rig import Rig
from bodyscan.rig.templates import ANYTHING, fill

STABLE_S = 0.5
"""An image without an end mark is whole when it has not grown for this long: camera drivers write a
file in one go, in hundredths of a second."""


@dataclass(frozen=True)
class Arrival:
    """What has arrived of a scan."""

    whole: tuple[str, ...]  # pairs with all their images
    complete: bool  # nothing more is expected
    # Of each pair that takes part, how many images are there, and how many are to come in all.
    images: Mapping[str, tuple[int, int]] = field(default_factory=dict)


@dataclass(frozen=True)
class _File:
    size: int
    changed_ns: int
    since_s: float
    whole: bool


class IncomingScan:
    """One scan's folder, examined repeatedly.

    since_ns: when the folder's earlier job ended, 0 if there was none. Images of a retake replace
        those of before one by one: a pair is whole once all its images are newer.
    """

    def __init__(self, folder: Path, rig: Rig, since_ns: int = 0) -> None:
        self.folder, self.rig, self._since_ns = folder, rig, since_ns
        self._files: dict[Path, _File] = {}
        self._changed_s: float | None = None

    def look(self, now_s: float, quiet_s: float) -> Arrival:
        """Look at what is there now.

        now_s: of a monotonic clock.
        quiet_s: a scan to which nothing was added for this long is taken as it is.
        """
        if self._look_for_changes(now_s) or self._changed_s is None:
            self._changed_s = now_s
        try:
            sequences = open_scan(self.rig, self.folder).sequences
        except CaptureError:
            sequences = ()  # nothing yet, or an error that the scan itself will report
        striped = [sequence for sequence in sequences if sequence.has_stripes]
        whole = {sequence.pair for sequence in striped if self._is_whole(sequence, now_s)}
        if (self.folder / CAPTURES).exists():
            expected = {sequence.pair for sequence in striped}
        else:
            expected = {pair.name for pair in self.rig.pairs if pair.projector is not None}
        mark = self._files.get(self.folder / "done")
        is_marked = mark is not None and mark.changed_ns > self._since_ns
        complete = is_marked or (bool(whole) and expected <= whole)
        complete |= now_s - self._changed_s >= quiet_s
        counts = {s.pair: (len(s.paths) - len(s.missing), len(s.paths)) for s in sequences}
        return Arrival(tuple(sorted(whole)), complete, counts)

    def _is_whole(self, sequence: ImageSequence, now_s: float) -> bool:
        if sequence.missing:
            return False
        there = [self._files[path] for path in sequence.paths if path in self._files]
        whole = [
            one.changed_ns > self._since_ns and (one.whole or now_s - one.since_s >= STABLE_S)
            for one in there
        ]
        return len(there) == len(sequence.paths) and all(whole)

    def _look_for_changes(self, now_s: float) -> bool:
        """Check every file in the folder; returns whether one came, went or changed."""
        before, self._files = self._files, {}
        for path in list_files(self.folder):
            try:
                found = os.stat(path)
            except OSError:
                continue
            stamp = (found.st_size, found.st_ctime_ns)  # a copy may keep the time of its original
            known = before.get(path)
            if known is None or stamp != (known.size, known.changed_ns):
                known = _File(*stamp, now_s, has_end_mark(path, found.st_size))
            self._files[path] = known
        return before != self._files


def has_end_mark(path: Path, size: int) -> bool:
    """Whether the last bytes show that the file is complete; False for formats without an end mark."""
    ends = {".png": b"IEND\xaeB`\x82", ".jpg": b"\xff\xd9", ".jpeg": b"\xff\xd9"}
    end = ends.get(path.suffix.lower())
    if end is None or size < len(end) or not path.is_file():
        return False
    try:
        with path.open("rb") as stream:
            stream.seek(-len(end), os.SEEK_END)
            return stream.read() == end
    except OSError:
        return False


def put_image(
    inbox: Path, rig: Rig, scan: str, pair: str, frame: str, image: Bytes, *, shot: str = "s01"
) -> Path:
    """Write an image from memory to where `watch` expects that frame; returns its path.

    image: (height, width) uint8 or uint16. The file appears complete or not at all.

    Raises BadInput for a pair, a frame, or a template of `files`, that yields no image name.
    """
    paths = [one for one in (scan, shot, frame) if Path(one).name != one or one[:1] in (".", "")]
    known = {one.name: rig.frames.sequence_names(one.projector) for one in rig.pairs}
    if paths or frame not in (*known.get(pair, ()), pair in known and rig.frames.dark):
        why = f"{paths[0]!r} is no name" if paths else f"rig {rig.name} has no pair {pair}"
        if pair in known and not paths:
            why = f"pair {pair} has no frame {frame}: its frames are {', '.join(known[pair])}"
        raise BadInput(why, where=f"scan {scan}, frame {frame}")
    name = fill(rig.files, shot=shot, pair=pair, frame=frame)
    lossless = (".png", ".tif", ".tiff", ".bmp", ".pgm")
    if ANYTHING in name or Path(name).suffix.lower() not in lossless:
        raise BadInput(
            f"`files` is {rig.files}, by which no image can be written",
            where=f"rig {rig.name}",
            remedy=f"calibrate with a template that has no * and ends in one of {lossless}",
        )
    path = Path(inbox) / scan / name
    path.parent.mkdir(parents=True, exist_ok=True)
    quickly = [cv2.IMWRITE_PNG_COMPRESSION, 1] if path.suffix.lower() == ".png" else []
    write_bytes(path, cv2.imencode(path.suffix, image, quickly)[1].tobytes())
    return path


@dataclass(frozen=True)
class Watched:
    """What is watched and what to do with it.

    quiet_s: a scan with missing images is taken as it is if nothing has arrived for this long.
    preview: tell what has arrived, and the cloud before it is meshed (events `images`, `cloud`).
    """

    inbox: Path
    out: Path
    calibration: Path
    pipeline: Pipeline
    quiet_s: float = 30.0
    command: Sequence[str] = COMMAND
    preview: bool = False


def watch(
    watched: Watched,
    listen: Listen = ignore_events,
    *,
    once: bool = False,
    stopped: Event | None = None,
) -> dict[str, Any]:
    """Fuse every scan of the inbox as its images arrive, until interrupted or `stopped`, or, with
    `once`, until everything there is done. Returns the event that ends a batch.

    A job that fails twice is set aside with its reason, and the others go on. Raises BadInput if
    the inbox is not a folder, if a batch or another watch is working in `out`, or if the
    calibration is unusable.
    """
    if not watched.inbox.is_dir():
        raise BadInput("there is no such folder", where=str(watched.inbox), remedy="make it first")
    rig = read_rig_of(watched.calibration)
    with hold_output(watched.out):
        process, rest = ResidentProcess(watched), _RestProcess(watched)
        scans, others = ThreadPoolExecutor(1), ThreadPoolExecutor(1)

        def scan(job: Job) -> JobResult:
            job = replace(job, until=KINDS["fuse"][0].name)
            return write_or_refuse(job) or supervise_job(job, process, listen)

        def complete(job: Job, scanned: Future[JobResult]) -> JobResult:
            before = scanned.result()
            if before.state != "done":
                return before
            after = write_or_refuse(job) or supervise_job(job, rest, listen)
            seconds = round(before.seconds + after.seconds, 1)
            return replace(after, stages=before.stages + after.stages, seconds=seconds)

        def submit(job: Job) -> Future[JobResult]:
            # Measures and report take as long as a scan: the next person does not wait for them.
            return others.submit(complete, job, scans.submit(scan, job))

        watching = _Watching(watched, process, submit, listen)
        try:
            process.start()
            while True:
                for folder in watching.folders():
                    if folder not in watching.scans:
                        since_ns = find_retake_time(folder, watching.state_file(folder))
                        watching.scans[folder] = IncomingScan(folder, rig, since_ns)
                    watching.look_at(watching.scans[folder])
                for outcome in watching.take_ended():
                    listen({"event": "job", **asdict(outcome)})
                    listen(watching.summary())
                if (once and not watching.scans) or (stopped and stopped.is_set()):
                    return watching.summary()
                time.sleep(0.1)
        finally:
            for pool, worker in ((scans, process), (others, rest)):
                pool.shutdown(wait=False, cancel_futures=True)
                worker.stop()


@dataclass
class _Watching:
    """scans: not ended yet. prepared: pairs that were sent. running: jobs. shown: of their images."""

    watched: Watched
    process: ResidentProcess
    submit: Callable[[Job], Future[JobResult]]
    listen: Listen
    scans: dict[Path, IncomingScan] = field(default_factory=dict)
    prepared: dict[Path, set[str]] = field(default_factory=dict)
    running: dict[Path, Future[JobResult]] = field(default_factory=dict)
    jobs: dict[Path, Job] = field(default_factory=dict)
    ended: dict[Path, JobResult] = field(default_factory=dict)
    shown: dict[Path, Arrival] = field(default_factory=dict)
    _turn: int = 0

    def state_file(self, path: Path) -> Path:
        """Path of the file that records how a scan's job ended."""
        return self.watched.out / make_job_name(path.name) / STATE

    def folders(self) -> list[Path]:
        """Folders of scans that are not done: what an earlier watch or batch did stays done.

        One that is done is done again if images come to it: one of them is looked at in each call.
        """
        watched = self.watched
        found = []
        done = [path for path in self.ended if path not in self.scans]
        self._turn += 1
        retaken = done[self._turn % len(done)] if done else None
        if retaken and not find_retake_time(retaken, self.state_file(retaken)):
            retaken = None
        for path in sorted(watched.inbox.absolute().iterdir()):
            is_folder = path.is_dir() and path != watched.out.absolute()
            if path.name.startswith(".") or not is_folder:
                continue
            if path in self.ended and path not in self.scans and path != retaken:
                continue
            if any((path / name).exists() for name in RESULTS):
                continue
            is_new = path not in self.scans and path not in self.ended
            if is_new and (outcome := find_earlier(path, self.state_file(path))):
                self.jobs[path], self.ended[path] = self._job(path), outcome
                continue
            found.append(path)
        return found

    def look_at(self, scan: IncomingScan) -> None:
        """Request decoding of what has arrived, and the job once everything has."""
        path = scan.folder
        if path in self.running:
            return
        arrival = scan.look(time.monotonic(), self.watched.quiet_s)
        if self.watched.preview and arrival != self.shown.get(path):
            self.shown[path] = arrival
            job, images = make_job_name(path.name), dict(arrival.images)
            self.listen({"event": "images", "job": job, "scan": path.name, "pairs": images})
        new = set(arrival.whole) - self.prepared.setdefault(path, set())
        if new:
            self.prepared[path] |= new
            self.process.prepare(path, sorted(new))
        # A folder without images waits until nothing else does: hundreds of them delay nobody.
        if arrival.complete and (arrival.whole or not self.running):
            self.jobs[path] = self._job(path)
            self.running[path] = self.submit(self.jobs[path])

    def take_ended(self) -> list[JobResult]:
        """Results of jobs that have ended since the last call. Raises what ended the process."""
        done = [path for path, future in self.running.items() if future.done()]
        for path in done:
            self.ended[path] = self.running.pop(path).result()
            del self.scans[path], self.prepared[path]
            self.shown.pop(path, None)
        return [self.ended[path] for path in done]

    def summary(self) -> dict[str, Any]:
        """Rewrite the table and the manifest of all jobs; return the event that sums them up."""
        if not self.ended:
            return {"event": "summary", "jobs": 0, "set_aside": [], "repeat": []}
        jobs = [self.jobs[path] for path in self.ended]
        return finish(jobs, list(self.ended.values()), self.watched.out)

    def _job(self, path: Path) -> Job:
        watched = self.watched
        last = KINDS["fuse"][-1].name
        return make_job(path, watched.pipeline, watched.out, watched.calibration.absolute(), last)


def find_retake_time(source: Path, state: Path) -> int:
    """When (ns) a scan's job ended, if a file of its folder is newer; 0 otherwise."""
    with suppress(OSError):
        since = state.stat().st_mtime_ns
        if any(os.stat(path).st_ctime_ns > since for path in list_files(source)):
            return since
    return 0


def find_earlier(source: Path, state: Path) -> JobResult | None:
    """How a scan's job ended before this watch began; None if its images, or a file of its results,
    have changed or gone since, or if it was set aside, perhaps for want of memory or disk."""
    content = read_record(state)
    if content.get("state") != "done" or find_retake_time(source, state):
        return None
    folder, since = state.parent, state.stat().st_mtime_ns
    for stage in KINDS["fuse"]:
        named = read_record(folder / stage.name / STAGE).get("outputs")
        there = list_results_in(folder / stage.name)
        if not isinstance(named, dict) or there.keys() != named.keys():
            return None
        if any(os.stat(path).st_ctime_ns > since for path in there.values()):
            return None
    attempts, seconds = content.get("attempts", 0), content.get("seconds", 0.0)
    return JobResult(folder.name, "done", attempts, tuple(content.get("stages", ())), seconds)


class _RestProcess:
    """A new process for each attempt at the stages after a scan, which gives way to the scans."""

    def __init__(self, watched: Watched) -> None:
        threads, command = watched.pipeline.resources.threads, tuple(watched.command)
        self._starter = JobProcess(threads, command, self._take)
        self._process: Popen[str] | None = None
        self._is_stopped = False

    def attempt(self, job: Job, listen: Listen) -> tuple[str, tuple[str, ...]]:
        """See `JobProcess`. Raises FailedWork once stopped, so that the job begins anew later."""
        if self._is_stopped:
            raise FailedWork("stopped")
        return self._starter.attempt(job, listen)

    def _take(self, process: Popen[str]) -> None:
        self._process = process
        with suppress(OSError):  # it has ended
            os.setpriority(os.PRIO_PROCESS, process.pid, 10)

    def stop(self) -> None:
        """Kill it; none is started again."""
        self._is_stopped = True
        if self._process is not None:
            self._process.kill()


class ResidentProcess:
    """A process that stays, with the calibration loaded: it decodes what arrives, and does jobs."""

    def __init__(self, watched: Watched) -> None:
        self._arguments = (*watched.command, "--resident", str(watched.calibration))
        self._calibration, self._threads = watched.calibration, watched.pipeline.resources.threads
        self._preview = watched.preview
        self._process: Popen[str] | None = None
        self._is_stopped = False
        self._sent: set[Path] = set()
        self._suspected: set[Path] = set()

    def start(self) -> None:
        """Start it (again). Raises BadInput if the calibration is unusable, else FailedWork."""
        if self._is_stopped:
            raise FailedWork("stopped")
        self._process = start_process(self._arguments, self._threads)
        first = next(read_messages(self._process), {})
        if "unusable" in first:
            raise (BadInput if first["exit_code"] == 2 else FailedWork)(first["unusable"])
        if "ready" not in first:
            raise FailedWork(
                f"the process that fuses scans does not start: exit status {self._process.wait()}",
                where=str(self._calibration),
                remedy="run `bodyscan scan` on one of the scans for a full message",
            )

    def prepare(self, folder: Path, pairs: Sequence[str]) -> None:
        """Request decoding of a scan's pairs; not of one whose images may have ended the process."""
        if folder not in self._suspected:
            self._sent.add(folder)
            self._send(folder=str(folder), pairs=pairs)

    def attempt(self, job: Job, listen: Listen) -> tuple[str, tuple[str, ...]]:
        """Why the job failed, "" if it did not; and the stages that ran. Raises as `start`."""
        assert self._process is not None
        if self._process.poll() is not None:
            self._suspected |= self._sent
            self.start()
        self._send(folder=str(job.folder), preview=self._preview)
        return listen_to(self._process, job, listen)

    def _send(self, **request: Any) -> None:
        """Send a request; whether the process has died is noticed at the next job."""
        assert self._process is not None
        assert self._process.stdin is not None
        with suppress(OSError):
            os.write(self._process.stdin.fileno(), json.dumps(request).encode() + b"\n")

    def stop(self) -> None:
        """Kill it; it is not started again."""
        self._is_stopped = True
        if self._process is not None:
            self._process.kill()
            self._process.wait()
