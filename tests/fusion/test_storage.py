"""Results in a folder: none is mixed with another, nothing else is touched."""

from pathlib import Path

import pytest

from bodyscan.errors import ResultError
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
    with pytest.raises(ResultError, match="lies here already"):
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
