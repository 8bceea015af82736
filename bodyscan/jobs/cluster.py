"""The same jobs on many machines: a dask.distributed cluster starts the job command on each worker.

Scans and output are in folders that all machines see under the same path, or in object storage.
dask sends a job again if its worker is lost; the lost worker's process ends by itself, its
unfinished results are removed, and a job that was already done is found done.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence

from bodyscan.errors import BadInput, FailedWork
from bodyscan.jobs import supervision
from bodyscan.jobs.batch import Run, Work
from bodyscan.jobs.job import Job
from bodyscan.jobs.supervision import JobProcess, JobResult, Listen, ignore_events


def run_on_cluster(
    address: str,
    threads: int,
    command: Sequence[str] = supervision.COMMAND,
    listen: Listen = ignore_events,
    work: Work = supervision.supervise_job,
) -> Run:
    """Run jobs on the cluster whose scheduler listens at `address`, such as tcp://host:8786.

    threads: per job. The cluster decides how many jobs run at once: one for each thread of each
        worker (`dask worker --nthreads`).

    Raises BadInput if dask.distributed is not installed, FailedWork if nobody answers or there is
    no worker.
    """
    try:
        from distributed import Client, as_completed
    except ImportError:
        raise BadInput(
            "--cluster needs dask.distributed, which is not installed",
            remedy="pip install 'bodyscan[cluster]' here and on every worker",
        ) from None

    def run(jobs: Sequence[Job]) -> Iterator[JobResult]:
        try:
            client = Client(address, timeout=20, set_as_default=False)
            client.wait_for_workers(1, timeout=20)
        except (OSError, ValueError) as error:
            raise FailedWork(
                f"no dask scheduler with a worker answers ({error})",
                where=address,
                remedy="start one with `dask scheduler`, and `dask worker ADDRESS` on each machine",
            ) from error
        process = JobProcess(threads, tuple(command))
        with client:
            futures = {
                client.submit(run_on_worker, work, job, process, pure=False): job.name
                for job in jobs
            }
            for future in futures:
                listen({"event": "job", "job": futures[future], "state": "sent"})
            for future in as_completed(futures, loop=client.loop):
                lost = future.exception()
                if lost is None:
                    yield future.result()
                else:
                    yield JobResult(futures[future], "set aside", reason=f"on the cluster: {lost}")

    return run


def run_on_worker(work: Work, job: Job, process: JobProcess) -> JobResult:
    """Do one job on a worker."""
    os.umask(0o077)
    if work is supervision.supervise_job and not job.folder.is_dir():
        return JobResult(
            job.name,
            "set aside",
            reason=f"{job.folder} is not there on this worker: share folders under one path",
        )
    return work(job, process, ignore_events)
