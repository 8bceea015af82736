"""Results in a folder: none is mixed with another, nothing else is touched."""

import json
from pathlib import Path

import pytest
from made_scan import make_scan
from small_workspace import run

from bodyscan.errors import FailedWork, ResultError
from bodyscan.files.atomic import write_json
from bodyscan.fusion.storage import clear, make_room


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


def test_a_folder_without_a_result_is_left_as_it_is(result: Path) -> None:
    (result / "scan.json").unlink()
    before = sorted(result.iterdir())
    clear(result)
    assert sorted(result.iterdir()) == before


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
