"""A rig that stood still is valid; one that was touched is not, and can be repaired."""

import shutil
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_workspace import Workspace, run

from bodyscan.alignment.icp import Alignment, Overlap
from bodyscan.errors import BoardNotFound
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.registration.storage import load_calibration, save_calibration
from bodyscan.workflows.check_rig import ScanCheck, judge_scans


@pytest.fixture
def board_shots(workspace: Workspace, tmp_path: Path) -> Path:
    """Three shots of the board; without captures.yaml, as someone would copy them together."""
    shots = sorted((workspace.folder / "captures" / "calibration").glob("b*"))
    lit_by_all = [s for s in shots if len(list(s.glob("*/lit.png"))) >= 3][:3]
    for shot in lit_by_all:
        shutil.copytree(shot, tmp_path / "boards" / shot.name)
    return tmp_path / "boards"


@pytest.fixture
def touched(workspace: Workspace, tmp_path: Path) -> Path:
    """A calibration that is wrong by what a touched camera would make it wrong: 1 mm sideways."""
    calibration = load_calibration(workspace.folder / "calibration")
    sideways = RigidTransform(np.eye(3), np.array([0.6, 0.8, 0.0]))
    placing = dict(calibration.rig_from_camera)
    placing["p2-3"] = sideways @ placing["p2-3"]
    save_calibration(replace(calibration, rig_from_camera=placing), tmp_path / "touched")
    return tmp_path / "touched"


def test_a_rig_that_stood_still_is_valid(workspace: Workspace, board_shots: Path) -> None:
    folder = workspace.folder / "calibration"
    result = run("check-calibration", board_shots, "--calibration", folder)
    assert result.exit_code == 0, result.output
    assert "valid: all that see the board agree" in result.output


def test_a_touched_pair_is_named_and_put_right(
    workspace: Workspace, board_shots: Path, touched: Path, tmp_path: Path
) -> None:
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


def test_where_nothing_can_be_told_the_causes_are(workspace: Workspace, board_shots: Path) -> None:
    """One pair's images alone, two of them exchanged."""
    (shot,) = [s for s in board_shots.iterdir() if len(list(s.glob("*/bit00.png"))) > 0][:1]
    pair = next(iter(shot.glob("*/bit00.png"))).parent
    for other in board_shots.iterdir():
        if other != shot:
            shutil.rmtree(other)
    for other in shot.iterdir():
        if other != pair:
            shutil.rmtree(other)
    (pair / "bit02.png").rename(pair / "kept.png")
    (pair / "bit03.png").rename(pair / "bit02.png")
    (pair / "kept.png").rename(pair / "bit03.png")
    (board_shots / "captures.yaml").write_text("kind: calibration\n", "utf-8")
    result = run(
        "check-calibration", board_shots, "--calibration", workspace.folder / "calibration"
    )
    assert isinstance(result.exception, BoardNotFound)
    assert "no board is seen by two calibrated pairs" in str(result.exception)
    assert "frames do not form a valid code" in str(result.exception)


def test_a_scan_of_a_person_is_checked_too(workspace: Workspace) -> None:
    person = workspace.folder / "captures" / "person"
    result = run("check-calibration", person, "--calibration", workspace.folder / "calibration")
    assert "overlaps in 1 scan:" in result.output
    # The small rig's two poles stand on either side of the person and share no more than rims.
    assert result.exit_code == 0, result.output
    assert "no surface is seen by more than one" not in " ".join(result.output.split())


def test_boards_and_people_are_not_mixed(workspace: Workspace, board_shots: Path) -> None:
    person = workspace.folder / "captures" / "person"
    folder = workspace.folder / "calibration"
    result = run("check-calibration", person, board_shots, "--calibration", folder)
    assert result.exit_code != 0
    assert "cannot be checked together" in str(result.exception)


def aligned(motions: dict[str, np.ndarray], joined: bool = True) -> Alignment:
    """Every pair overlaps with the next one; or all but the last."""
    placing = {name: RigidTransform(np.eye(3), shift) for name, shift in motions.items()}
    names = list(motions) if joined else list(motions)[:-1]
    overlaps = tuple(Overlap(a, b, 1000, 0.1, 0.1) for a, b in pairwise(names))
    return Alignment(placing, {}, {}, overlaps)


def judge(scans: list[Alignment], start: dict[str, RigidTransform], poles: Any = None) -> ScanCheck:
    """Scans whose pairs have no times."""
    return judge_scans(scans, start, poles or {}, [dict.fromkeys(start)] * len(scans))


@pytest.mark.parametrize("shift", [0.0, 0.8])
def test_a_move_is_told_from_sway_by_several_scans(shift: float) -> None:
    rng = np.random.default_rng(3)
    names = [f"p{pole}-{k}" for pole in (1, 2, 3) for k in (1, 2)]
    constant = {name: np.array([shift if name == "p2-1" else 0.0, 0.0, 0.0]) for name in names}
    scans = [
        aligned({name: constant[name] + rng.normal(0, 0.3, 3) for name in names}) for _ in range(12)
    ]
    start = {name: RigidTransform.identity() for name in names}
    check = judge(scans, start, {name: name[:2] for name in names})
    assert check.valid == (shift == 0.0)
    assert [drift.pair for drift in check.pairs if drift.moved] == (["p2-1"] if shift else [])
    # Of two scans nothing can be said.
    assert not judge(scans[:2], start).moved
    assert not judge(scans[:2], start).decided


def test_pairs_that_share_nothing_with_the_others_are_not_confirmed() -> None:
    """A pole that moved so far that no surface is near enough to its neighbours' leaves overlaps
    that are as good as ever."""
    names = ["p1-1", "p1-2", "p2-1", "p3-1"]
    still = {name: np.zeros(3) for name in names}
    start = {name: RigidTransform.identity() for name in names}
    good = judge([aligned(still)], start)
    assert good.quiet
    assert judge([aligned(still)] * 3, start).decided
    apart = judge([aligned(still, joined=False)] * 3, start)
    assert not apart.quiet
    assert not apart.decided
    assert apart.groups == (("p1-1", "p1-2", "p2-1"), ("p3-1",))
    assert not apart.valid
    assert "undecided: no surface is seen by more than one" in apart.lines[0]
    assert "p1-1, p1-2, p2-1; p3-1" in apart.lines[0]
    # One scan that joins them is enough.
    assert judge([aligned(still, joined=False), aligned(still)], start).quiet
