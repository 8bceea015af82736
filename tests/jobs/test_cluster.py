"""Jobs on a local dask cluster of two workers, one of which is killed midway."""

from __future__ import annotations

import json
import logging
import os
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from functools import partial
from pathlib import Path

import cheap_job
import pytest
from cheap_batch import jobs_of, results, run_cheap
from processes import told_of, wait_for

from bodyscan.errors import BodyscanError
from bodyscan.jobs.batch import run_batch, run_on_cluster, run_on_worker, stage_versions
from bodyscan.jobs.job import write_job
from bodyscan.jobs.supervision import JobProcess, supervise_job


def test_a_lost_worker_loses_nothing_and_nothing_is_done_twice(
    make_scans: Callable[..., Path], tmp_path: Path
) -> None:
    distributed = pytest.importorskip(
        "distributed", reason="dask.distributed is not installed (pip install '.[cluster]')"
    )
    scans = make_scans(**{f"s{number}": "sleep 0.4" for number in range(5)})
    assert run_cheap(scans, tmp_path / "undisturbed").code == 0
    out, outcomes = tmp_path / "out", []
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None, silence_logs="CRITICAL"
    ) as cluster:
        run = run_on_cluster(cluster.scheduler_address, 1, cheap_job.COMMAND)
        batch = threading.Thread(
            target=lambda: outcomes.extend(run_batch(jobs_of(scans, out), out, run))
        )
        batch.start()
        os.kill(int(told_of(_a_running_job(out))[1]), signal.SIGKILL)
        batch.join(timeout=60)
        assert not batch.is_alive()
    assert [outcome.state for outcome in outcomes] == ["done"] * 5, outcomes
    assert results(out) == {
        name: value
        for name, value in results(tmp_path / "undisturbed").items()
        if name != "manifest.json"  # over all jobs: written when a batch is finished
    }
    for job in jobs_of(scans, out):
        assert (job.folder / "log.txt").read_text().count("made an export") == 1
    begun = sum((out / f"s{k}" / "log.txt").read_text().count("-- ") for k in range(5))
    assert begun == 6, "five jobs, one of them begun again on the other worker"


def test_a_scheduler_that_dies_sets_the_rest_aside_with_a_remedy(
    make_scans: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("distributed", reason="dask.distributed is not installed")
    scans = make_scans(**{f"s{number}": "sleep 0.5" for number in range(6)})
    out, outcomes = tmp_path / "out", []
    logged: list[logging.LogRecord] = []
    monkeypatch.setattr(logging.getLogger("distributed.client"), "handle", logged.append)
    command = ("-m", "distributed.cli.dask_scheduler", "--port", "0", "--no-dashboard")
    file = tmp_path / "scheduler.json"
    scheduler = _start(*command, "--scheduler-file", str(file))
    wait_for(file.exists)
    address = json.loads(file.read_text())["address"]
    worker = _start("-m", "distributed.cli.dask_worker", address, "--nthreads", "1", "--no-nanny")
    try:
        run = run_on_cluster(address, 1, cheap_job.COMMAND)
        batch = threading.Thread(
            target=lambda: outcomes.extend(run_batch(jobs_of(scans, out), out, run))
        )
        batch.start()
        _a_running_job(out)
        scheduler.kill()
        batch.join(timeout=90)
        assert not batch.is_alive()
    finally:
        scheduler.kill()
        worker.kill()
    assert len(outcomes) == 6
    aside = [outcome.reason for outcome in outcomes if outcome.state == "set aside"]
    assert aside
    assert all("scheduler" in reason and "start the same batch" in reason for reason in aside)
    assert not any("\n" in reason for reason in aside)
    assert not logged, "tracebacks between the lines of a batch"


def _start(*arguments: str) -> subprocess.Popen[bytes]:
    with_path = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    quiet = subprocess.DEVNULL
    return subprocess.Popen([sys.executable, *arguments], stdout=quiet, stderr=quiet, env=with_path)


def test_a_worker_of_another_version_or_without_the_files_does_nothing(
    make_scans: Callable[..., Path], tmp_path: Path
) -> None:
    scans, out = make_scans(a="nothing"), tmp_path / "out"
    (job,) = jobs_of(scans, out)
    write_job(job)
    process = JobProcess(1, cheap_job.COMMAND)
    assert run_on_worker(supervise_job, job, process, stage_versions()).state == "done"
    other = stage_versions() | {"bodyscan": "0.0.1"}
    refused = run_on_worker(supervise_job, job, process, other)
    assert "0.0.1" in refused.reason
    assert "same version" in refused.reason
    shutil.rmtree(scans)
    lost = run_on_worker(supervise_job, job, process, stage_versions())
    assert (lost.state, "not there on this worker" in lost.reason) == ("set aside", True)
    assert str(scans) in lost.reason


def test_a_scheduler_that_is_not_there_is_named(
    make_scans: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    distributed = pytest.importorskip("distributed", reason="dask.distributed is not installed")
    connect = partial(distributed.Client, timeout=1)
    monkeypatch.setattr(
        distributed, "Client", lambda address, **_: connect(address, set_as_default=False)
    )
    run = run_on_cluster("tcp://127.0.0.1:9", 1)
    with pytest.raises(BodyscanError, match="no dask scheduler with a worker answers"):
        run_batch(jobs_of(make_scans(a="nothing"), tmp_path / "out"), tmp_path / "out", run)


def test_without_dask_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "distributed", None)
    with pytest.raises(BodyscanError, match="bodyscan\\[cluster\\]"):
        run_on_cluster("tcp://127.0.0.1:9", 1)


def _a_running_job(out: Path) -> int:
    """The process that holds the lock of a job in the middle of its work."""
    making = wait_for(lambda: list(out.glob("*/.making-scan-*")))
    return int((making[0].parent / "lock").read_text().split()[1])
