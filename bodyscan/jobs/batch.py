"""Many jobs: a lock on the output folder, jobs side by side, events, and the final state."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict
from pathlib import Path

from bodyscan.errors import BadInput, BodyscanError, FailedWork
from bodyscan.files.atomic import lock_file, restrict_to_owner
from bodyscan.jobs.allocation import Allocation
from bodyscan.jobs.job import BATCH_LOCK, STAGE, Job, write_job
from bodyscan.jobs.supervision import (
    COMMAND,
    JobProcess,
    JobResult,
    Listen,
    ignore_events,
    supervise_job,
)

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
                _tell(outcome, listen)
            since = time.monotonic()
            waiting = {job.name for job in ready if not (job.folder / job.until / STAGE).exists()}
            for outcome in run(ready):
                outcomes[outcome.job] = outcome
                waiting.discard(outcome.job)
                _tell(outcome, listen)
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


def _tell(outcome: JobResult, listen: Listen) -> None:
    listen({"event": "job", **asdict(outcome)})


def finish(jobs: Sequence[Job], outcomes: Sequence[JobResult], out: Path) -> dict[str, object]:
    """Write the table and the manifest over all jobs; returns the event that ends a batch.

    Raises FailedWork if they cannot be written.
    """
    from bodyscan.jobs.summary import (
        drifted,
        odd_stature,
        to_repeat,
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
            remedy="make room, then start the same batch again: what is done stays done",
        ) from error
    aside = [outcome.job for outcome in outcomes if outcome.state != "done"]
    done = [job for job in jobs if job.name not in aside]
    return {
        "event": "summary",
        "jobs": len(jobs),
        "done": len(jobs) - len(aside),
        "ran": sum(bool(outcome.stages) for outcome in outcomes),
        "set_aside": aside,
        "repeat": to_repeat(done),
        "drifted": {one.pair: round(one.shift_mm, 2) for one in drifted(done)},
        "odd_stature_mm": odd_stature(done),
        "table": str(table),
    }
