"""Scans and results in object storage, here fsspec's own in memory."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cheap_job
import pytest
from cheap_batch import results
from fsspec.implementations.memory import MemoryFileSystem
from typer.testing import CliRunner

from bodyscan.cli.main import app
from bodyscan.errors import BadInput, FailedWork
from bodyscan.files.atomic import scratch_folder, sweep_scratch
from bodyscan.jobs.batch import Allocation, finish, run_batch, run_locally
from bodyscan.jobs.object_storage import (
    Store,
    fetch_figures,
    find_stored_jobs,
    put_summary,
    work_on_stored,
)
from bodyscan.jobs.pipeline import load_pipeline
from bodyscan.jobs.supervision import JobResult

fsspec = pytest.importorskip("fsspec", reason="fsspec is not installed (pip install '.[cluster]')")


class Buckets(MemoryFileSystem):  # type: ignore[misc]  # it has no types
    """Its paths begin with a bucket, as those of S3 do, which writing would make."""

    @classmethod
    def _strip_protocol(cls, path: str) -> str:
        return path.removeprefix("buckets://").strip("/")


STORE = Store("memory://day/scans", "memory://day/out", "memory://day/calibration")


@pytest.fixture
def memory(batched: Path) -> Iterator[Any]:
    """The file system of a store that holds two scans."""
    system = fsspec.filesystem("memory")
    system.store.clear()
    scans = batched / "scans"
    for path in scans.glob("*/*"):
        system.pipe_file(f"/day/scans/{path.relative_to(scans)}", path.read_bytes())
    system.pipe_file("/day/calibration/calibration.json", b"{}")
    yield system
    system.store.clear()


def batch(tmp_path: Path, name: str) -> dict[str, JobResult]:
    """What `bodyscan batch` does with URLs, with cheap stages."""
    work = tmp_path / name
    jobs = find_stored_jobs(STORE, load_pipeline(cheap_job.PIPELINE), "export", work)
    task = partial(work_on_stored, store=STORE)
    outcomes = run_batch(
        jobs, work / "out", run_locally(Allocation(2, 1, ""), cheap_job.COMMAND, work=task)
    )
    fetch_figures(jobs, STORE)
    finish(jobs, outcomes, work / "out")
    put_summary(work / "out", STORE)
    return {outcome.job: outcome for outcome in outcomes}


def test_the_same_bytes_as_in_folders_and_nothing_twice(
    memory: MemoryFileSystem, batched: Path, tmp_path: Path
) -> None:
    first = batch(tmp_path, "first")
    assert {outcome.state for outcome in first.values()} == {"done"}, first
    memory.get("/day/out", str(tmp_path / "fetched"), recursive=True)
    assert results(tmp_path / "fetched") == results(batched / "out")
    assert (tmp_path / "fetched" / "summary.csv").exists()
    again = batch(tmp_path, "again")
    assert all(outcome.stages == () for outcome in again.values())


def test_an_upload_cut_short_is_made_again(memory: MemoryFileSystem, tmp_path: Path) -> None:
    batch(tmp_path, "first")
    memory.rm("/day/out/anna/scan/stage.json")
    memory.pipe_file("/day/out/bert/export/body.bin", b"half")
    memory.pipe_file("/day/out/anna/scan/measurements.json", b"mine")
    again = batch(tmp_path, "again")
    assert again["anna"].stages == ("scan",)
    assert again["bert"].stages == ("export",)
    assert len(memory.cat_file("/day/out/bert/export/body.bin")) > 4
    (kept,) = memory.glob("/day/out/anna/kept-*/*")  # nothing of what was cut short
    assert memory.cat_file(kept) == b"mine"


def test_names_that_climb_out_are_refused(memory: MemoryFileSystem, tmp_path: Path) -> None:
    memory.store["/day/scans/anna/../../../escaped"] = memory.store["/day/scans/anna/do.txt"]
    outcomes = batch(tmp_path, "first")
    assert outcomes["anna"].state == "set aside"
    assert "leads out of its folder" in outcomes["anna"].reason
    assert outcomes["bert"].state == "done"


def test_the_command_takes_urls(memory: MemoryFileSystem) -> None:
    """All the way through the real command, whose real stage then refuses this calibration."""
    places = ("--scans", STORE.scans, "--out", STORE.out, "--calibration", str(STORE.calibration))
    result = CliRunner().invoke(app, ["batch", str(cheap_job.PIPELINE), *places, "--json"])
    assert result.exit_code == 1, result.output
    assert json.loads(result.stdout.splitlines()[-1])["set_aside"] == ["anna", "bert"]
    table = memory.cat_file("/day/out/summary.csv").decode()
    assert table.count("is not a readable calibration") == 2
    state = json.loads(memory.cat_file("/day/out/anna/state.json"))
    assert state["attempts"] == 2
    half = CliRunner().invoke(app, ["batch", str(cheap_job.PIPELINE), *places[:3], "out"])
    assert "either all in object storage or none" in str(half.exception)


def test_what_a_killed_batch_left_in_the_temporary_folder_is_swept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    program = (
        "import os, sys, tempfile; tempfile.tempdir = sys.argv[1]\n"
        "from bodyscan.files.atomic import scratch_folder\n"
        "with scratch_folder() as folder:\n"
        "    (folder / 'lit.png').write_bytes(b'a person')\n"
        "    os.kill(os.getpid(), 9)\n"
    )
    subprocess.run([sys.executable, "-c", program, tmp_path], check=False)
    (left,) = tmp_path.iterdir()
    (tmp_path / "bodyscan-scratch-new").mkdir()  # not locked yet
    (tmp_path / "bodyscan-mine").mkdir()  # somebody else's
    with scratch_folder() as folder:
        assert not left.exists()
        with scratch_folder() as other:  # of another job at the same time
            sweep_scratch()
            assert folder.exists()
        assert not other.exists()
        sweep_scratch(with_own=True)  # as on Ctrl-C, after which nothing is tidied up
        assert not folder.exists()
    left_alone = {"bodyscan-mine", "bodyscan-scratch-new"}
    assert {path.name for path in tmp_path.iterdir()} == left_alone


@pytest.mark.parametrize(
    "url", ["scans memory", "calibration memory", "out buckets", "scans nowhere"]
)
def test_what_is_not_there_is_named_by_its_url(
    memory: MemoryFileSystem, tmp_path: Path, url: str
) -> None:
    part, kind = url.split()
    fsspec.register_implementation("buckets", Buckets, clobber=True)
    store = replace(STORE, **{part: f"{kind}://nobucket/{part}"})
    with pytest.raises(BadInput, match=rf"{kind}://nobucket/{part}: (holds nothing|cannot be op)"):
        find_stored_jobs(store, load_pipeline(cheap_job.PIPELINE), "export", tmp_path)


def test_a_store_that_does_not_answer_is_a_sentence(
    memory: MemoryFileSystem, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pipeline = load_pipeline(cheap_job.PIPELINE)
    jobs = find_stored_jobs(STORE, pipeline, "export", tmp_path)

    def fail(*_: object, **__: object) -> None:
        raise RuntimeError("Could not connect to the endpoint\n  and much more")

    for name in ("exists", "isfile", "put_file", "makedirs"):
        monkeypatch.setattr(MemoryFileSystem, name, fail)
    for ask in (
        lambda: find_stored_jobs(STORE, pipeline, "export", tmp_path / "again"),
        lambda: fetch_figures(jobs, STORE),
        lambda: put_summary(tmp_path, STORE),
    ):
        with pytest.raises(FailedWork, match=r"memory://day/.*does not answer.*endpoint") as told:
            ask()
        assert "much more" not in str(told.value)
