"""What is done again, and why: content counts, names of files' places and times do not."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import cheap_job
import pytest
from cheap_batch import jobs_of, run_cheap

from bodyscan.files.hashing import list_files
from bodyscan.jobs.job import Job
from bodyscan.jobs.plan import describe_origin, find_reason_to_run


@pytest.fixture
def day(batched: Path, tmp_path: Path) -> Path:
    """Scans and what a batch made of them, both in one folder."""
    return shutil.copytree(batched, tmp_path / "day")


def steps(day: Path, *changes: str, version: int = 1) -> list[str]:
    """Of Anna's job, why each stage would run now."""
    anna, bert = jobs_of(day / "scans", day / "out", *changes)
    if not changes and version == 1:
        assert reasons(bert) == ["", ""]
    return reasons(anna, version)


def reasons(job: Job, version: int = 1) -> list[str]:
    stages = cheap_job.kinds(version)["fuse"]
    return [find_reason_to_run(job, describe_origin(job, stage)) for stage in stages]


def test_times_and_places_do_not_count(day: Path) -> None:
    for path in (day / "scans" / "anna").iterdir():
        os.utime(path, (1, 1))
    assert steps(day) == ["", ""]
    moved = day / "moved"
    moved.mkdir()
    for name in ("scans", "out"):
        shutil.move(day / name, moved / name)
    assert steps(moved) == ["", ""]


def test_content_and_files_that_come_and_go_count(day: Path) -> None:
    folder = day / "scans" / "anna"
    (folder / "image.txt").write_text("other")
    assert steps(day) == ["inputs changed: image.txt has other content", ""]
    (folder / "image.txt").rename(folder / "picture.txt")
    assert steps(day)[0] == "inputs changed: picture.txt is new, image.txt is gone"


def test_versions_count_and_settings_for_the_stages_that_obey_them(day: Path) -> None:
    changed = "settings changed: fusion.points 1000000 -> 2000"
    assert steps(day, "fusion.points=2000") == [changed, ""]
    changed = 'settings changed: export.formats ["ply", "obj", "stl", "glb"] -> ["ply"]'
    assert steps(day, "export.formats=ply") == ["", changed]
    assert steps(day, "resources.threads=1") == ["", ""]
    assert steps(day, version=2)[0] == "version 2 of the stage, it was 1"


def test_results_that_were_touched_are_made_again(day: Path) -> None:
    result = day / "out" / "anna" / "scan" / "1.bin"
    result.write_bytes(b"x" + result.read_bytes()[1:])
    assert steps(day)[0] == "its result was changed: 1.bin has other content"
    assert run_cheap(day / "scans", day / "out").endings()["anna"]["stages"] == ["scan"]
    assert steps(day) == ["", ""]


def add(day: Path) -> tuple[Path, Path]:
    """Files of a person's own among Anna's results, one in a folder."""
    added = (day / "out/anna/scan/measurements.json", day / "out/anna/scan/export/body.ply")
    for path in added:
        path.parent.mkdir(exist_ok=True)
        path.write_text("mine")
    return added


def test_files_that_a_person_added_do_not_count_and_are_kept(day: Path) -> None:
    added = add(day)
    assert steps(day) == ["", ""]
    assert run_cheap(day / "scans", day / "out").endings()["anna"]["stages"] == []
    assert all(path.read_text() == "mine" for path in added)
    (day / "scans" / "anna" / "image.txt").write_text("other")
    told = run_cheap(day / "scans", day / "out").events
    (kept,) = (day / "out" / "anna").glob("kept-scan-*")
    names = {path.relative_to(kept).as_posix() for path in list_files(kept)}
    assert names == {"measurements.json", "export/body.ply"}
    assert [event["kept"] for event in told if "kept" in event] == [kept.name]
    assert not any(path.exists() for path in added)  # they belong to the former result
    assert steps(day) == ["", ""]


def test_files_that_a_person_added_outlive_a_kill(day: Path) -> None:
    """Between the steps that put a new result in place of the former."""
    add(day)
    job = day / "out" / "anna"
    (job / "scan").rename(job / ".old-scan-0123")
    assert run_cheap(day / "scans", day / "out").endings()["anna"]["stages"] == ["scan"]
    assert (job / "kept-scan-0123" / "measurements.json").read_text() == "mine"
    assert len(list(list_files(job / "kept-scan-0123"))) == 2
    assert not list(job.glob(".old-*"))


def test_a_failure_is_told_the_next_time(make_scans: Callable[..., Path], tmp_path: Path) -> None:
    scans = make_scans(a="raise")
    run_cheap(scans, tmp_path / "out")
    (job,) = jobs_of(scans, tmp_path / "out")
    (scan, *_) = cheap_job.kinds()["fuse"]
    reason = find_reason_to_run(job, describe_origin(job, scan))
    assert reason == "it failed last time: ValueError: a bad day"


def test_models_beside_scans_are_no_jobs(make_scans: Callable[..., Path], tmp_path: Path) -> None:
    scans = make_scans(anna="nothing")
    (scans / "anna-model").mkdir()
    (scans / "anna-model" / "scan.json").write_text("{}")
    assert [job.name for job in jobs_of(scans, tmp_path / "out")] == ["anna"]
