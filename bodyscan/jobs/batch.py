"""Many jobs: how many at once, a lock on the output folder, events, and the final state."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path

from bodyscan.errors import BadInput, BodyscanError, FailedWork
from bodyscan.files.atomic import lock_file, restrict_to_owner
from bodyscan.jobs.job import BATCH_LOCK, STAGE, Job, write_job
from bodyscan.jobs.supervision import (
    COMMAND,
    JobProcess,
    JobResult,
    Listen,
    ignore_events,
    supervise_job,
)
from bodyscan.settings import Resources

Run = Callable[[Sequence[Job]], Iterator[JobResult]]
"""Starts jobs and yields each result as soon as the job ends."""

Work = Callable[[Job, JobProcess, Listen], JobResult]
"""Does a Job: `supervise_job`, or that on a local copy (see object_storage)."""


def run_batch(
    jobs: Sequence[Job], out: Path, run: Run, listen: Listen = ignore_events
) -> list[JobResult]:
    """Bring every job up to date; returns results in the order of the jobs.

    A job that fails is set aside with its reason, and the others go on. Raises BadInput if another
    batch is working in `out`, or `out` is not writable.
    """
    with restrict_to_owner():
        try:
            out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise BadInput(f"cannot be written: {error.strerror}", where=str(out)) from error
        with lock_file(out / BATCH_LOCK, wait=False):
            sweep(out)
            listen({"event": "batch", "jobs": [job.name for job in jobs]})
            outcomes: dict[str, JobResult] = {}
            ready = []
            for job in jobs:
                try:
                    write_job(job)
                    ready.append(job)
                except (BodyscanError, OSError) as error:
                    outcomes[job.name] = JobResult(job.name, "set aside", reason=str(error))
            for outcome in outcomes.values():
                listen({"event": "job", **asdict(outcome)})
            since = time.monotonic()
            waiting = {job.name for job in ready if not (job.folder / job.until / STAGE).exists()}
            for outcome in run(ready):
                outcomes[outcome.job] = outcome
                waiting.discard(outcome.job)
                listen({"event": "job", **asdict(outcome)})
                left = seconds_left(list(outcomes.values()), waiting, time.monotonic() - since)
                ended = {"ended": len(outcomes), "jobs": len(jobs), "seconds_left": left}
                listen({"event": "progress", **ended})
    return [outcomes[job.name] for job in jobs]


def seconds_left(
    ended: Sequence[JobResult], waiting: Collection[str], spent_s: float
) -> float | None:
    """Estimated time to the end of a batch, from the durations of jobs that had something to do.

    waiting: jobs without a result; those up to date take no time.

    None if no job has shown yet how long one takes.
    """
    took = [outcome.seconds for outcome in ended if outcome.state == "done" and outcome.stages]
    if not waiting or not took:
        return None if waiting else 0.0
    at_once = max(1.0, sum(outcome.seconds for outcome in ended) / max(spent_s, 1e-3))
    return round(len(waiting) * sum(took) / len(took) / at_once, 1)


def run_locally(
    shares: Allocation,
    command: Sequence[str] = COMMAND,
    listen: Listen = ignore_events,
    work: Work = supervise_job,
) -> Run:
    """Run jobs on this machine, `shares.workers` at a time."""

    def run(jobs: Sequence[Job]) -> Iterator[JobResult]:
        pool = ThreadPoolExecutor(shares.workers)
        try:
            process = JobProcess(shares.threads, tuple(command))
            futures = [pool.submit(work, job, process, listen) for job in jobs]
            for future in as_completed(futures):
                yield future.result()
        finally:
            pool.shutdown(wait=False, cancel_futures=True)

    return run


def sweep(out: Path) -> None:
    """Remove files that a batch was writing when it was killed."""
    for path in (*out.glob(".summary.*.tmp.csv"), *out.glob(".manifest.*.tmp.json")):
        path.unlink(missing_ok=True)


def finish(jobs: Sequence[Job], outcomes: Sequence[JobResult], out: Path) -> dict[str, object]:
    """Write the table and the manifest over all jobs; returns the event that ends a batch.

    Raises FailedWork if they cannot be written.
    """
    from bodyscan.jobs.summary import (
        find_drift,
        find_odd_stature,
        scans_to_repeat,
        write_out_manifest,
        write_summary,
    )

    try:
        with restrict_to_owner():
            table = write_summary(jobs, outcomes, out)
            write_out_manifest(out)
    except OSError as error:
        raise FailedWork(
            f"the summary cannot be written: {error.strerror}",
            where=str(out),
            remedy="make room, then start the same batch again: jobs that are done stay done",
        ) from error
    aside = [outcome.job for outcome in outcomes if outcome.state != "done"]
    done = [job for job in jobs if job.name not in aside]
    return {
        "event": "summary",
        "jobs": len(jobs),
        "done": len(jobs) - len(aside),
        "ran": sum(bool(outcome.stages) for outcome in outcomes),
        "set_aside": aside,
        "repeat": scans_to_repeat(done),
        "drifted": {one.pair: round(one.shift_mm, 2) for one in find_drift(done)},
        "odd_stature_mm": find_odd_stature(done),
        "table": str(table),
    }


@dataclass(frozen=True)
class Allocation:
    """workers: jobs at the same time. threads: per job. why: what limits them, in words."""

    workers: int
    threads: int
    why: str


def allocate(
    resources: Resources, jobs: int, workers: int | None, cores: int, memory_mb: float
) -> Allocation:
    """Choose as many jobs at once as cores and memory allow, but no more than there are.

    workers: a number requested by the user; more workers get fewer threads each, but never more
        memory than there is.
    """
    by_memory = max(1, int(memory_mb // resources.memory_mb))
    wanted = workers or max(1, cores // resources.threads)
    count = max(1, min(wanted, by_memory, jobs))
    threads = max(1, min(resources.threads, cores // count))
    why = f"{cores} cores, {memory_mb / 1000.0:.1f} GB free"
    if count == by_memory < min(wanted, jobs):
        why += f"; memory limits them, a job takes {resources.memory_mb / 1000.0:g} GB"
    return Allocation(count, threads, why)


def cores() -> int:
    """Number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def free_memory_mb() -> float:
    """Memory that is free on the machine, or left to this container, in MB (1e6 bytes)."""
    free = [float("inf")]
    with suppress(OSError, ValueError):
        for line in Path("/proc/meminfo").read_text("ascii").splitlines():
            if line.startswith("MemAvailable:"):
                free.append(int(line.split()[1]) * 1024 / 1e6)
    with suppress(OSError, ValueError):
        group = Path("/sys/fs/cgroup")
        limit = int((group / "memory.max").read_text("ascii"))
        free.append((limit - int((group / "memory.current").read_text("ascii"))) / 1e6)
    return min(free) if len(free) > 1 else 4000.0
