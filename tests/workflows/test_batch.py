"""Real scans through the real command, faulty ones among them."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from small_workspace import PROJECT, Workspace, run
from typer.testing import Result

from bodyscan.files.hashing import hash_file, list_files

SMALL = ("--set", "fusion.points=20000", "--set", "mesh.depth=6", "--set", "export.formats=glb")
ODD = "б 'q\"\n"


def batch(day: Path, *more: object, pipeline: str = "fuse") -> Result:
    stages = PROJECT / "pipelines" / f"{pipeline}.yaml"
    return run("batch", stages, "--scans", day / "scans", "--out", day / "out", *more)


def events(result: Result) -> list[dict[str, Any]]:
    return [json.loads(line) for line in result.stdout.splitlines()]


def endings(result: Result) -> dict[str, dict[str, Any]]:
    return {e["job"]: e for e in events(result) if e["event"] == "job" and "reason" in e}


@pytest.fixture(scope="module")
def day(workspace: Workspace, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A day's first scan."""
    day = tmp_path_factory.mktemp("day")
    person = workspace.folder / "captures" / "person"
    shutil.copytree(workspace.folder / "calibration", day / "calibration")
    shutil.copytree(person, day / "scans" / "anna")
    return day


def put_what_comes_later(day: Path) -> None:
    """The same images under an odd name, and with what a bad disk leaves of them."""
    for name in (ODD, "hurt"):
        shutil.copytree(day / "scans" / "anna", day / "scans" / name)
    first, second = (day / "scans" / "hurt" / "s01" / pair for pair in ("p1-2", "p1-3"))
    (first / "lit.png").write_bytes((first / "lit.png").read_bytes()[:5000])
    (second / "lit.png").write_bytes(b"")


def put_what_a_bad_person_may(day: Path) -> None:
    (day / "scans" / "climbing").mkdir()
    climbing = "kind: scan\nshots: [{name: ../../anna/s01}]\n"
    (day / "scans" / "climbing" / "captures.yaml").write_text(climbing)
    (day / "scans" / "link").symlink_to("/etc")
    (day / "scans" / "inner").mkdir()
    (day / "scans" / "inner" / "s01").symlink_to("/etc")


@pytest.fixture(scope="module")
def night(day: Path) -> tuple[Result, Result]:
    """The batch over that day, stopped after the first stage, then finished with what came since."""
    first = batch(day, *SMALL, "--json", "--until", "scan")
    put_what_comes_later(day)
    put_what_a_bad_person_may(day)
    return first, batch(day, *SMALL, "--json")


def test_good_scans_are_fused_and_bad_ones_named(day: Path, night: tuple[Result, Result]) -> None:
    first, second = night
    assert second.exit_code == 1, second.output
    odd = next(name for name in endings(second) if name.startswith("q-"))
    good = {"anna", odd, "hurt"}
    assert {n for n, end in endings(second).items() if end["state"] == "done"} == good
    assert endings(first)["anna"]["stages"] == ["scan"]
    assert endings(second)["anna"]["stages"] == ["measures", "export", "report"]
    for name in (odd, "hurt"):
        assert endings(second)[name]["stages"] == ["scan", "measures", "export", "report"]
    for name, said in {
        "climbing": "shots[0].name",
        "link": "symbolic link that leads out",
        "inner": "symbolic link that leads out",
    }.items():
        end = endings(second)[name]
        assert end["state"] == "set aside"
        assert said in end["reason"]
        assert end["attempts"] == 2
    facts = json.loads((day / "out" / "hurt" / "scan" / "scan.json").read_text())
    assert sorted(facts["failed"]) == ["p1-2", "p1-3"]
    assert "cut short" in facts["failed"]["p1-2"]
    assert "is an empty file" in facts["failed"]["p1-3"]
    assert (day / "out" / "anna" / "export" / "body-light.glb").exists()
    assert (day / "out" / "anna" / "report" / "report.html").exists()


def test_the_table_has_a_row_for_every_scan(day: Path, night: tuple[Result, Result]) -> None:
    with (day / "out" / "summary.csv").open(newline="", encoding="utf-8") as stream:
        rows = {row["job"]: row for row in csv.DictReader(stream)}
    assert len(rows) == 6
    anna = rows["anna"]
    assert anna["subject"] == "sim-woman-average"
    assert anna["verdict"] in ("good", "usable", "repeat")
    assert 15_000 < int(anna["points"]) < 25_000
    assert 5.0 < float(anna["coverage_percent"]) <= 100.0  # one pole sees but one side
    assert 0.0 < float(anna["overlap_rms_after_mm"]) < 1.0
    assert 0.0 <= float(anna["sway_mm"]) < 5.0
    assert rows["hurt"]["pairs_failed"] == "p1-2 p1-3"
    assert "symbolic link" in rows["link"]["reason"]


def test_the_same_images_give_the_same_bytes(day: Path, night: tuple[Result, Result]) -> None:
    """In one go as with a stop after the first stage."""
    odd = next((day / "out").glob("q-*"))
    for stage in ("scan", "export", "report"):
        one, other = (
            {p.name: hash_file(p) for p in list_files(day / "out" / job / stage)}
            for job in ("anna", odd.name)
        )
        assert one == other


def test_what_is_done_stays_done_and_its_bytes_are_vouched_for(
    day: Path, night: tuple[Result, Result]
) -> None:
    assert run("verify", day / "out").exit_code == 0
    path = day / "out" / "anna" / "scan" / "mesh.ply"
    content = path.read_bytes()
    path.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    found = run("verify", day / "out")
    assert found.exit_code != 0
    assert f"{path}: was changed" in found.output
    path.write_bytes(content)


def test_a_subject_is_forgotten(day: Path, night: tuple[Result, Result], tmp_path: Path) -> None:
    shutil.copytree(day, tmp_path / "day", symlinks=True)
    result = run("forget", "sim-woman-average", "--workspace", tmp_path / "day", "--yes")
    assert result.exit_code == 0
    assert "out/anna (" in result.output
    left = {path.relative_to(tmp_path / "day").parts[:2] for path in list_files(tmp_path / "day")}
    assert ("scans", "anna") not in left
    assert ("out", "anna") not in left
    assert ("calibration", "calibration.json") in left
    assert not (tmp_path / "day" / "scans" / "anna").exists()
    assert Path("/etc/passwd").exists()  # a link to it lay there


def test_rigs_are_calibrated_in_batches(example: Path, tmp_path: Path) -> None:
    """The same bytes as the Python function's, and no more work the second time."""
    rig = tmp_path / "scans" / "small"
    rig.mkdir(parents=True)
    shutil.copy(example / "pole" / "rig.yaml", rig)
    shutil.copytree(example / "pole" / "captures" / "calibration", rig / "captures" / "calibration")
    done = batch(tmp_path, "--json", pipeline="calibrate")
    assert done.exit_code == 0, done.output
    made = tmp_path / "out" / "small" / "calibration"
    assert (made / "calibration.json").exists()  # its notes name images by path, so it differs
    name = "calibration.npz"
    assert hash_file(made / name) == hash_file(example / "made" / "calibration" / name)
    assert list((tmp_path / "out" / "small" / "rig").iterdir())
    assert events(batch(tmp_path, "--json", pipeline="calibrate"))[-1]["ran"] == 0


def test_no_calibration_is_bad_input(tmp_path: Path) -> None:
    (tmp_path / "scans" / "a").mkdir(parents=True)
    result = batch(tmp_path)
    assert result.exit_code != 0
    assert "no calibration/calibration.json" in str(result.exception)
