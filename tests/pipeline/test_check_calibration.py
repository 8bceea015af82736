"""A rig that stood still is valid; one that was touched is not, and can be repaired."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
from small_workspace import run

from bodyscan.calibration.storage import load_calibration, save_calibration
from bodyscan.evaluation.scan_check import judge_scans
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.registration.alignment import Alignment


@pytest.fixture
def board_shots(workspace, tmp_path):
    """Three shots of the board; without captures.yaml, as someone would copy them together."""
    shots = sorted((workspace.folder / "captures" / "calibration").glob("b*"))
    lit_by_all = [s for s in shots if len(list(s.glob("*/lit.png"))) >= 3][:3]
    for shot in lit_by_all:
        shutil.copytree(shot, tmp_path / "boards" / shot.name)
    return tmp_path / "boards"


@pytest.fixture
def touched(workspace, tmp_path):
    """A calibration that is wrong by what a touched camera would make it wrong: 1 mm sideways."""
    calibration = load_calibration(workspace.folder / "calibration")
    sideways = RigidTransform(np.eye(3), np.array([0.6, 0.8, 0.0]))
    placing = dict(calibration.rig_from_camera)
    placing["p2-3"] = sideways @ placing["p2-3"]
    save_calibration(replace(calibration, rig_from_camera=placing), tmp_path / "touched")
    return tmp_path / "touched"


def test_a_rig_that_stood_still_is_valid(workspace, board_shots):
    folder = workspace.folder / "calibration"
    result = run("check-calibration", board_shots, "--calibration", folder)
    assert result.exit_code == 0, result.output
    assert "valid: all that see the board agree" in result.output


def test_a_touched_pair_is_named_and_put_right(workspace, board_shots, touched, tmp_path):
    mended = tmp_path / "mended"
    before = (touched / "calibration.json").read_bytes()
    result = run("check-calibration", board_shots, "--calibration", touched, "--repair", mended)
    assert result.exit_code == 1
    assert "pair p2-3 moved by" in result.output
    assert "p1-" not in result.output.split("moved by")[0]
    assert (touched / "calibration.json").read_bytes() == before
    found = load_calibration(mended).rig_from_camera
    true = load_calibration(workspace.folder / "calibration").rig_from_camera
    off = np.linalg.norm(found["p2-3"].translation - true["p2-3"].translation)
    # Of 1 mm; three views at half size place a camera to some tenths.
    assert off < 0.5
    assert np.array_equal(found["p1-2"].matrix, true["p1-2"].matrix)
    assert any("p2-3" in note for note in load_calibration(mended).notes)
    again = run("check-calibration", board_shots, "--calibration", mended)
    assert again.exit_code == 0, again.output


def test_a_scan_of_a_person_is_checked_too(workspace):
    person = workspace.folder / "captures" / "person"
    result = run("check-calibration", person, "--calibration", workspace.folder / "calibration")
    assert result.exit_code == 0, result.output
    assert "overlaps in 1 scan:" in result.output


def test_boards_and_people_are_not_mixed(workspace, board_shots):
    person = workspace.folder / "captures" / "person"
    folder = workspace.folder / "calibration"
    result = run("check-calibration", person, board_shots, "--calibration", folder)
    assert result.exit_code != 0
    assert "cannot be checked together" in str(result.exception)


def aligned(motions: dict[str, np.ndarray]) -> Alignment:
    placing = {name: RigidTransform(np.eye(3), shift) for name, shift in motions.items()}
    return Alignment(placing, {}, {}, ())


@pytest.mark.parametrize("shift", [0.0, 0.8])
def test_a_move_is_told_from_sway_by_several_scans(shift):
    rng = np.random.default_rng(3)
    names = [f"p{pole}-{k}" for pole in (1, 2, 3) for k in (1, 2)]
    constant = {name: np.array([shift if name == "p2-1" else 0.0, 0.0, 0.0]) for name in names}
    scans = [
        aligned({name: constant[name] + rng.normal(0, 0.3, 3) for name in names}) for _ in range(12)
    ]
    start = {name: RigidTransform.identity() for name in names}
    check = judge_scans(scans, start, {name: name[:2] for name in names})
    assert check.valid == (shift == 0.0)
    assert [drift.pair for drift in check.pairs if drift.moved] == (["p2-1"] if shift else [])
    # Of two scans nothing can be said.
    assert judge_scans(scans[:2], start, {}).valid
    assert not judge_scans(scans[:2], start, {}).decided
