"""Results in a folder: a scan.json that is not one is refused, none is mixed with another."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_scan import make_scan
from small_workspace import run

from bodyscan.errors import BodyscanError, FailedWork, ResultError
from bodyscan.export.scan import export_scan
from bodyscan.files.atomic import write_json
from bodyscan.fusion.storage import clear, load_scan, make_room, read_facts

STORED = Path(__file__).parents[1] / "data" / "stored-0.1.0" / "scan"

MISTAKES: dict[str, Callable[[dict[str, Any]], Any]] = {
    "of another schema": lambda f: f.update(schema="other"),
    "of another version": lambda f: f.update(version=9),
    "without calibration": lambda f: f.pop("calibration_id"),
    "with a subject that is a number": lambda f: f.update(subject=7),
    "with a verdict that is a text": lambda f: f.update(verdict="good"),
    "with a grade unheard of": lambda f: f["verdict"].update(grade="splendid"),
    "with reasons that are a text": lambda f: f["verdict"].update(reasons="none"),
    "without the cloud's hash": lambda f: f["sha256"].pop("cloud.ply"),
    "with a file elsewhere": lambda f: f["sha256"].update({"../../other": "0" * 64}),
    "with a wrong hash": lambda f: f["sha256"].update({"mesh.ply": "0" * 64}),
    "with sway that is a text": lambda f: f["alignment"]["motion_mm"].update({"p1-2": "far"}),
    "with NaN": lambda f: f["alignment"]["motion_mm"].update({"p1-2": float("nan")}),
    "with an alignment that is a list": lambda f: f.update(alignment=[]),
    "with failures that are numbers": lambda f: f.update(failed={"p1-2": 3}),
}


def with_facts(folder: Path, text: str) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for name in ("cloud.ply", "mesh.ply"):
        shutil.copy(STORED / name, folder)
    (folder / "scan.json").write_text(text, "utf-8")
    return folder


@pytest.mark.parametrize("mistake", MISTAKES)
def test_what_is_not_the_result_of_a_scan_is_refused(mistake: str, tmp_path: Path) -> None:
    facts = json.loads((STORED / "scan.json").read_text("utf-8"))
    MISTAKES[mistake](facts)
    with pytest.raises(ResultError) as refused:
        load_scan(with_facts(tmp_path, json.dumps(facts)))
    assert str(tmp_path) in refused.value.where


@given(st.data())
def test_a_damaged_one_raises_nothing_but_our_own_errors(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    damaged = bytearray((STORED / "scan.json").read_bytes())
    for _ in range(data.draw(st.integers(1, 3))):
        start = data.draw(st.integers(0, len(damaged) - 1))
        damaged[start : start + data.draw(st.integers(0, 30))] = data.draw(st.binary(max_size=30))
    folder = with_facts(tmp_path_factory.getbasetemp() / "damaged", "")
    (folder / "scan.json").write_bytes(damaged)
    with suppress(BodyscanError):
        export_scan(load_scan(folder), folder / "out", ["stl"], ["full"])


def test_the_first_fault_is_named_and_a_calibration_has_a_name(tmp_path: Path) -> None:
    facts = json.loads((STORED / "scan.json").read_text("utf-8"))
    facts |= {"calibration_id": "", "failed": {"p1-2": 3}}
    (tmp_path / "scan.json").write_text(json.dumps(facts), "utf-8")
    with pytest.raises(ResultError, match=r"calibration_id: .* at least 1 character"):
        read_facts(tmp_path)
    with pytest.raises(ResultError, match="there is no such file"):
        read_facts(tmp_path / "elsewhere")
    # Earlier releases also wrote what they estimated of subsurface scattering.
    light = {"aside_mm": 0.1, "sigma_mm": 0.02, "taken_out": True}
    facts |= {"calibration_id": "7", "failed": {}, "oblique_light": light}
    (tmp_path / "scan.json").write_text(json.dumps(facts), "utf-8")
    assert read_facts(tmp_path) == facts


@pytest.fixture
def result(tmp_path: Path) -> Path:
    for name in ("scan.json", "cloud.ply", "mesh.ply", "mesh.png", "report.html", "notes.txt"):
        (tmp_path / name).write_text("somebody's")
    (tmp_path / "export").mkdir()
    (tmp_path / "export" / "body.obj").write_text("somebody's")
    (tmp_path / "holiday.png").write_text("not ours")
    return tmp_path


def test_a_result_is_not_replaced_unasked(result: Path, tmp_path: Path) -> None:
    with pytest.raises(ResultError, match="already exists here"):
        make_room(result, overwrite=False)
    make_room(result, overwrite=True)
    make_room(tmp_path / "new", overwrite=False)
    (result / "cloud.ply").unlink()  # a scan that found nobody may be tried again
    make_room(result, overwrite=False)


def test_nothing_of_one_person_stays_beside_anothers(result: Path) -> None:
    clear(result)
    assert sorted(path.name for path in result.iterdir()) == ["holiday.png", "notes.txt"]
    (result / "mesh.ply").write_text("of no result")
    clear(result)
    assert (result / "mesh.ply").exists()


@pytest.fixture
def bad_scan(tmp_path: Path) -> Path:
    """An egg whose verdict is to scan again."""
    folder = make_scan(tmp_path / "scan").folder
    facts = json.loads((folder / "scan.json").read_text("utf-8"))
    verdict = {"grade": "repeat", "reasons": ["the person walked away"]}
    write_json(folder / "scan.json", facts | {"verdict": verdict})
    return folder


@pytest.mark.parametrize("command", ["measure", "export"])
def test_nothing_is_made_of_a_scan_to_be_repeated_unless_that_is_said(
    command: str, bad_scan: Path
) -> None:
    before = sorted(bad_scan.rglob("*"))
    refused = run(command, bad_scan)
    assert isinstance(refused.exception, FailedWork)
    assert refused.exception.exit_code == 1
    assert "the person walked away" in str(refused.exception)
    assert "--anyway" in refused.exception.remedy
    assert sorted(bad_scan.rglob("*")) == before
    assert run(command, bad_scan, "--anyway").exit_code == 0
