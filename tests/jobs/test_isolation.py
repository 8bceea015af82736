"""A bad scan costs itself: it is tried again, set aside with its reason, and the others go on."""

from __future__ import annotations

import csv
import os
import stat
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cheap_job
from cheap_batch import jobs_of, results, run_cheap

from bodyscan.jobs.job import write_job
from bodyscan.jobs.supervision import JobProcess, supervise_job
from bodyscan.settings import Resources


def test_crashes_and_errors_take_nobody_with_them(
    make_scans: Callable[..., Path], tmp_path: Path
) -> None:
    todo = {"crash": "crash", "exit": "exit", "raise": "raise", "once": "once", "good": "nothing"}
    scans = make_scans(**todo)
    done = run_cheap(scans, tmp_path / "out")
    assert done.code == 1
    ends = done.endings()
    assert {name: end["state"] for name, end in ends.items()} == {
        "crash": "set aside",
        "exit": "set aside",
        "raise": "set aside",
        "once": "done",
        "good": "done",
    }
    assert "SIGSEGV" in ends["crash"]["reason"]
    assert "ended with 3" in ends["exit"]["reason"]
    assert ends["raise"]["reason"] == "ValueError: a bad day"
    attempts = {name: end["attempts"] for name, end in ends.items()}
    assert attempts == {"crash": 2, "exit": 2, "raise": 2, "once": 2, "good": 1}
    assert done.events[-1]["set_aside"] == ["crash", "exit", "raise"]
    with (tmp_path / "out" / "summary.csv").open(newline="") as stream:
        rows = {row["job"]: row for row in csv.DictReader(stream)}
    assert rows["raise"]["reason"] == "ValueError: a bad day"
    assert rows["good"]["state"] == "done"


def test_a_job_that_is_stuck_is_ended(make_scans: Callable[..., Path], tmp_path: Path) -> None:
    (job,) = jobs_of(make_scans(a="sleep 60"), tmp_path)
    soon = job.pipeline.model_copy(update={"resources": Resources(limit_minutes=0.025)})
    write_job(job)
    outcome = supervise_job(replace(job, pipeline=soon), JobProcess(1, tuple(cheap_job.COMMAND)))
    assert outcome.state == "set aside"
    assert "took longer than" in outcome.reason


def test_a_scan_that_changes_while_it_is_read_is_not_believed(
    make_scans: Callable[..., Path], tmp_path: Path
) -> None:
    scans = make_scans(moving="change", still="nothing")
    ends = run_cheap(scans, tmp_path / "out").endings()
    assert ends["moving"]["state"] == "set aside"
    assert "changed while it was read" in ends["moving"]["reason"]
    assert not (tmp_path / "out" / "moving" / "scan").exists()
    assert ends["still"]["state"] == "done"
    (scans / "moving" / "do.txt").write_text("nothing")
    assert run_cheap(scans, tmp_path / "out").code == 0


def test_a_pipe_among_the_images_is_not_waited_for(
    make_scans: Callable[..., Path], tmp_path: Path
) -> None:
    scans = make_scans(a="nothing", b="nothing")
    os.mkfifo(scans / "a" / "image2.txt")
    ends = run_cheap(scans, tmp_path / "out").endings()
    assert "is not a regular file" in ends["a"]["reason"]
    assert ends["b"]["state"] == "done"


def test_odd_names_neither_hurt_nor_leak(make_scans: Callable[..., Path], tmp_path: Path) -> None:
    names = ["a b", "it's \"quoted\"", "two\nlines", "Ωμέγα", "-rf", "..x", "$(touch x)", "[red]x",
             "summary.csv", "n" * 200]  # fmt: skip
    scans = make_scans(**dict.fromkeys(names, "nothing"))
    before = set(tmp_path.rglob("*"))
    done = run_cheap(scans, tmp_path / "out")
    made = set(tmp_path.rglob("*")) - before
    assert done.code == 0, done.errors
    assert len(done.endings()) == len(names) - 1  # `..x` is hidden
    assert all(path.is_relative_to(tmp_path / "out") for path in made)
    folders = [path.name for path in (tmp_path / "out").iterdir() if path.is_dir()]
    assert all(name.isascii() and name.isprintable() and " " not in name for name in folders)


def test_a_link_in_the_output_folder_is_not_followed(
    make_scans: Callable[..., Path], tmp_path: Path
) -> None:
    scans, elsewhere = make_scans(a="nothing", b="nothing"), tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "log.txt").write_text("theirs")
    (tmp_path / "out" / "b").mkdir(parents=True)
    (tmp_path / "out" / "a").symlink_to(elsewhere)
    (tmp_path / "out" / "b" / "log.txt").symlink_to(elsewhere / "log.txt")
    ends = run_cheap(scans, tmp_path / "out").endings()
    assert ends["a"]["state"] == ends["b"]["state"] == "set aside"
    assert "is a link" in ends["a"]["reason"]
    assert [path.name for path in elsewhere.iterdir()] == ["log.txt"]
    assert (elsewhere / "log.txt").read_text() == "theirs"


def test_everything_is_readable_by_its_owner_alone(
    make_scans: Callable[..., Path], tmp_path: Path
) -> None:
    out = tmp_path / "out"
    assert run_cheap(make_scans(a="nothing", b="raise"), out).code == 1
    assert len(results(out)) > 4
    for path in (out, *out.rglob("*")):
        wanted = 0o700 if path.is_dir() else 0o600
        assert stat.S_IMODE(path.stat().st_mode) == wanted, path
