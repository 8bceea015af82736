"""What a result stands without costs itself alone; a result is there whole or not at all."""

from __future__ import annotations

from pathlib import Path
from typing import NoReturn
from unittest.mock import Mock

import pytest
from made_scan import make_scan
from seen_boards import SeenBoards, seen_boards
from small_workspace import run
from verdict_given import verdict_given

from bodyscan.files.hashing import hash_file
from bodyscan.fusion import verdict
from bodyscan.fusion.storage import Scan, load_scan, make_room
from bodyscan.registration.storage import load_calibration
from bodyscan.report import calibration_charts, calibration_page, pictures
from bodyscan.report.page import render
from bodyscan.report.result_page import write_report
from bodyscan.verdict import Verdict
from bodyscan.workflows import calibrate_rig, scan_person


def broken(*_: object, **__: object) -> NoReturn:
    raise KeyError("p2-2")


@pytest.fixture(scope="module")
def ring() -> SeenBoards:
    return seen_boards()


@pytest.fixture
def boards(ring: SeenBoards, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every rig file is that of the ring, whose boards are found."""
    monkeypatch.setattr(calibrate_rig, "load_rig", lambda _: ring.rig)
    monkeypatch.setattr(calibrate_rig, "open_captures", lambda *_: ring.captures(ring.views))
    monkeypatch.setattr(calibrate_rig, "find_all_boards", lambda *_: ring.found(ring.views))


@pytest.fixture
def calibrated(boards: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of a calibration whose remarks all failed."""
    for name in ("list_boards_not_found", "advise", "note_stripe_boards"):
        monkeypatch.setattr(calibrate_rig, name, broken)
    calibrate_rig.calibrate_folder(tmp_path / "rig.yaml", tmp_path / "calibration")
    return tmp_path / "calibration"


def killed(*_: object, **__: object) -> NoReturn:
    raise KeyboardInterrupt


@pytest.mark.parametrize("at", ["advise", "write_found_corners", "save_calibration"])
def test_a_calibration_that_is_killed_at_its_end_is_made_by_the_same_command(
    boards: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, at: str
) -> None:
    (tmp_path / "rig.yaml").touch()
    with monkeypatch.context() as kill:
        if at == "save_calibration":  # between its two files
            kill.setattr("bodyscan.registration.storage.write_json", killed)
        else:
            kill.setattr(calibrate_rig, at, killed)
        run("calibrate-rig", tmp_path / "rig.yaml")
    assert not (tmp_path / "calibration" / "calibration.json").exists()
    result = run("calibrate-rig", tmp_path / "rig.yaml")
    assert result.exit_code == 0, result.output
    assert load_calibration(tmp_path / "calibration").advice


def test_a_scan_that_is_killed_before_its_pictures_is_made_by_the_same_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made, out = make_scan(tmp_path), tmp_path / "out"
    scan = Scan(made.cloud, made.mesh, None, {}, {}, Verdict("good"), (), {})
    stands_for = {"scan_person": scan, "calibration_id": "0", "load_calibration": Mock(axes="")}
    stands_for["open_scan"] = Mock(subject="anna", when=None, simulated=False)
    for name, value in stands_for.items():
        monkeypatch.setattr(scan_person, name, Mock(return_value=value))
    with monkeypatch.context() as kill:
        kill.setattr(scan_person, "write_pictures", killed)
        with pytest.raises(KeyboardInterrupt):
            scan_person.scan_folder(tmp_path, tmp_path, out, Mock())
        assert not any(out.glob("*"))
    make_room(out, overwrite=False)
    scan_person.scan_folder(tmp_path, tmp_path, out, Mock())
    assert load_scan(out).facts["subject"] == "anna"


def test_a_remark_that_fails_costs_itself_alone(ring: SeenBoards, calibrated: Path) -> None:
    found = load_calibration(calibrated)
    assert sorted(found.pairs) == sorted(ring.placings)
    failures = [note.partition(":")[0] for note in found.notes if "KeyError" in note]
    assert failures == ["boards that were not found", "advice", "boards by the stripes"]


def test_a_report_goes_on_after_a_section_that_fails(
    calibrated: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(calibration_charts, "build_rig_model", broken)
    monkeypatch.setattr(calibration_charts, "draw_sigma_chart", broken)
    page = calibration_page.make_calibration_page(calibrated)
    told = {section.title: str(section.blocks) for section in page.sections}
    assert "KeyError" in told["The rig"]
    assert "KeyError" in told["How well each place is known"]
    assert sum("KeyError: 'p2-2'" in blocks for blocks in told.values()) == 3  # and in the notes
    assert "'c1'" in told["Pairs"]
    render(page)
    titles = {note.partition(":")[0] for note in page.notes}
    assert titles == {"The rig", "How well each place is known"}


def test_a_scans_report_goes_on_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scan = make_scan(tmp_path / "scan")
    monkeypatch.setattr(pictures, "draw_mesh", broken)
    path, page = write_report(scan.folder)
    assert path.read_text("utf-8").count("failed with KeyError") == 1
    assert page.notes[-1].startswith("mesh.png")


def test_a_picture_that_cannot_be_drawn_costs_itself_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scan = make_scan(tmp_path / "scan")
    before = {name: hash_file(scan.folder / name) for name in ("cloud.ply", "mesh.ply")}
    monkeypatch.setattr(pictures, "draw_mesh", broken)
    every = pictures.draw_pictures(scan.cloud), pictures.draw_pictures(scan.mesh)
    drawn = pictures.write_pictures(every, scan.folder)
    assert [path.name for path in drawn.value] == ["cloud.png", "sigma.png", "pairs.png"]
    assert all(path.exists() for path in drawn.value)
    (note,) = drawn.notes
    assert note.startswith("mesh.png: left out")
    assert before == load_scan(scan.folder).facts["sha256"]
    monkeypatch.setattr(pictures, "write_bytes", Mock(side_effect=OSError("No space left")))
    with pytest.raises(OSError, match="No space"):  # the same command makes all once there is room
        pictures.write_pictures(every, scan.folder)


def test_a_verdict_that_misses_a_check_is_not_good(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scan = make_scan(tmp_path / "scan")
    whole = verdict_given(scan.cloud, scan.mesh)
    monkeypatch.setattr(verdict, "CHECKS", (*verdict.CHECKS, broken))
    missed = verdict_given(scan.cloud, scan.mesh)
    said = set(missed.reasons) - set(whole.reasons)
    assert len(said) == 1
    assert "verdict on broken" in said.pop()
    assert missed.grade == "usable"
