"""Many jobs: how many at once, here or on a cluster, a lock on the output folder, events, and the
final state. A batch that was cut short resumes: `plan.find_reason_to_run` names the stages to run,
`worker` renames a result once it is complete, and `hold_output` clears what was half written here."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

from bodyscan.errors import BadInput, BodyscanError, FailedWork
from bodyscan.files.atomic import lock_file, restrict_to_owner, sweep_temporary
from bodyscan.jobs.job import BATCH_LOCK, JOB, Job, write_job
from bodyscan.jobs.stages import KINDS
from bodyscan.jobs.supervision import (
    COMMAND,
    JobProcess,
    JobResult,
    Listen,
    ignore_events,
    supervise_job,
)
from bodyscan.settings import Resources
from bodyscan.version import __version__

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
    with hold_output(out):
        listen({"event": "batch", "jobs": [job.name for job in jobs]})
        refused = {job.name: refusal for job in jobs if (refusal := write_or_refuse(job))}
        outcomes: dict[str, JobResult] = {}
        for outcome in chain(
            refused.values(), run([job for job in jobs if job.name not in refused])
        ):
            outcomes[outcome.job] = outcome
            listen({"event": "job", **asdict(outcome)})
            listen({"event": "progress", "ended": len(outcomes), "jobs": len(jobs)})
    return [outcomes[job.name] for job in jobs]


@contextmanager
def hold_output(out: Path) -> Iterator[None]:
    """Make an output folder and lock it; what a killed batch was writing there is removed.

    Raises BadInput if another batch is working in it, OSError if it is not writable.
    """
    with restrict_to_owner():
        out.mkdir(parents=True, exist_ok=True)
        with lock_file(out / BATCH_LOCK, wait=False):
            for folder in (out, *(path.parent for path in out.glob(f"*/{JOB}"))):
                sweep_temporary(folder)
            yield


def write_or_refuse(job: Job) -> JobResult | None:
    """Write job.json; if that fails, the result of a job that is set aside for it."""
    try:
        write_job(job)
    except (BodyscanError, OSError) as error:
        return JobResult(job.name, "set aside", reason=str(error))
    return None


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


def run_on_cluster(
    address: str,
    threads: int,
    command: Sequence[str] = COMMAND,
    listen: Listen = ignore_events,
    work: Work = supervise_job,
) -> Run:
    """Run jobs on the dask cluster whose scheduler listens at `address`, such as tcp://host:8786.

    Scans and output are in folders that all machines see under the same path, or in object storage.
    dask sends a job again if its worker is lost; the lost worker's process ends by itself, its
    unfinished results are removed, and a job that was already done is found done.

    threads: per job. The cluster decides how many jobs run at once: one for each thread of each
        worker (`dask worker --nthreads`).

    Raises BadInput without dask.distributed, FailedWork if nobody answers or there is no worker.
    """
    try:
        from distributed import Client
        from distributed import as_completed as as_ended
    except ImportError:
        raise BadInput(
            "--cluster needs dask.distributed, which is not installed",
            remedy="pip install 'bodyscan[cluster]' here and on every worker",
        ) from None

    def run(jobs: Sequence[Job]) -> Iterator[JobResult]:
        try:
            client = Client(address, timeout=20, set_as_default=False)
            # It prints tracebacks of what becomes a job's reason below.
            logging.getLogger("distributed.client").setLevel(logging.CRITICAL + 1)
            client.wait_for_workers(1, timeout=20)
        except (OSError, ValueError) as error:
            raise FailedWork(
                f"no dask scheduler with a worker answers ({error})",
                where=address,
                remedy="start one with `dask scheduler`, and `dask worker ADDRESS` on each machine",
            ) from error
        process = JobProcess(threads, tuple(command))
        with client:
            task = partial(run_on_worker, work, process=process, versions=stage_versions())
            futures = {client.submit(task, job, pure=False): job.name for job in jobs}
            for future in futures:
                listen({"event": "job", "job": futures[future], "state": "sent"})
            missing = set(futures.values())
            for future in as_ended(futures, loop=client.loop):
                missing.remove(futures[future])
                yield _await_result(future, futures[future])
            for name in sorted(missing):
                yield _cluster_lost(name, "")

    return run


def _await_result(future: Any, job: str) -> JobResult:
    """Wait for the result of a job that a cluster did, or lost."""
    from concurrent.futures import CancelledError

    try:
        return future.result()
    except CancelledError as lost:  # with the scheduler, or the connection to it
        return _cluster_lost(job, str(lost).partition("\n")[0].rstrip("."))
    except Exception as error:
        return JobResult(job, "set aside", reason=f"on the cluster: {error}")


def _cluster_lost(job: str, why: str) -> JobResult:
    """The result of a job that was with a scheduler which is gone."""
    lost = f"the cluster's scheduler no longer answers{f' ({why})' if why else ''}"
    return JobResult(job, "set aside", reason=f"{lost}: start it, then start the same batch again")


def stage_versions() -> dict[str, Any]:
    """The version of bodyscan and of its stages, which decide what a result is made of."""
    stages = {kind: {stage.name: stage.version for stage in each} for kind, each in KINDS.items()}
    return {"bodyscan": __version__, "stages": stages}


def run_on_worker(
    work: Work, job: Job, process: JobProcess, versions: Mapping[str, Any]
) -> JobResult:
    """Do one job on a worker, which must have the versions of where the batch was started."""
    os.umask(0o077)
    reason = ""
    if (ours := stage_versions()) != versions:
        reason = (
            f"this worker has bodyscan {ours['bodyscan']}, stages {ours['stages'][job.pipeline.kind]};"
            f" the batch was started by {versions['bodyscan']}, stages "
            f"{versions['stages'].get(job.pipeline.kind)}: install the same version on every machine"
        )
    elif work is supervise_job:
        read = [path for path in (job.folder, job.source, job.calibration) if path is not None]
        if lost := [str(path) for path in read if not path.exists()]:
            reason = f"{lost[0]} is not there on this worker: share folders under one path"
    if reason:
        return JobResult(job.name, "set aside", reason=reason)
    return work(job, process, ignore_events)


def finish(jobs: Sequence[Job], outcomes: Sequence[JobResult], out: Path) -> dict[str, object]:
    """Write the table and the manifest over all jobs; returns the event that ends a batch."""
    from bodyscan.jobs.summary import (
        find_drift,
        list_scans_to_repeat,
        write_day_measures,
        write_out_manifest,
        write_summary,
    )

    with restrict_to_owner():
        table = write_summary(jobs, outcomes, out)
        measures = write_day_measures(jobs, out)
        write_out_manifest(out)
    aside = [outcome.job for outcome in outcomes if outcome.state != "done"]
    done = [job for job in jobs if job.name not in aside]
    return {
        "event": "summary",
        "jobs": len(jobs),
        "done": len(jobs) - len(aside),
        "ran": sum(bool(outcome.stages) for outcome in outcomes),
        "set_aside": aside,
        "repeat": list_scans_to_repeat(done),
        "drifted": {one.pair: round(one.shift_mm, 2) for one in find_drift(done)},
        "table": str(table),
        "measures": measures and str(measures),
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
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1


def measure_free_memory_mb() -> float:
    """Memory that is free on the machine, or left to this container, in MB (1e6 bytes)."""
    free = [float("inf")]
    with suppress(OSError, ValueError):
        for line in Path("/proc/meminfo").read_text("ascii").splitlines():
            if line.startswith("MemAvailable:"):
                free.append(int(line.split()[1]) * 1024 / 1e6)
    group = Path("/sys/fs/cgroup")
    version_1 = ("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes")
    for limit, used in (("memory.max", "memory.current"), version_1):
        with suppress(OSError, ValueError):
            left = int((group / limit).read_text("ascii")) - int((group / used).read_text("ascii"))
            free.append(left / 1e6)
    return min(free) if len(free) > 1 else 4000.0
