"""What goes wrong costs that image or that pair, is named, and never the whole run."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from small_workspace import COARSER, Workspace, copy_pairs, run

from bodyscan.errors import ResultError
from bodyscan.fusion.storage import load_scan
from bodyscan.registration.storage import load_calibration


@pytest.fixture
def copy(workspace: Workspace, tmp_path: Path) -> Path:
    """A copy of the captures and the rig file, to be damaged."""
    folder = tmp_path / "copy"
    folder.mkdir()
    shutil.copy(workspace.folder / "rig.yaml", folder)
    shutil.copytree(workspace.folder / "captures", folder / "captures")
    return folder


def image(folder: Path, shot: str, pair: str, frame: str) -> Path:
    return folder / "captures" / "calibration" / shot / pair / f"{frame}.png"


def test_bad_images_cost_only_themselves(workspace: Workspace, tmp_path: Path) -> None:
    copy = tmp_path / "two"
    copy_pairs(workspace.folder, ("p1-2", "p2-2"), copy)
    shots = sorted(p.name for p in (copy / "captures" / "calibration").glob("b*"))
    with_pair = [s for s in shots if image(copy, s, "p1-2", "bit00").exists()]
    missing = image(copy, with_pair[0], "p1-2", "bit03")
    missing.unlink()
    unreadable = image(copy, with_pair[1], "p1-2", "bit01")
    unreadable.write_bytes(unreadable.read_bytes()[:2000])
    resized = image(copy, with_pair[2], "p1-2", "lit")
    cv2.imwrite(str(resized), np.full((100, 100), 128, np.uint8))
    black = image(copy, with_pair[3], "p1-2", "lit")
    cv2.imwrite(str(black), np.zeros_like(cv2.imread(str(black), 0)))
    boardless = image(copy, with_pair[4], "p1-2", "lit")
    cv2.imwrite(str(boardless), np.full_like(cv2.imread(str(boardless), 0), 90))
    result = run("calibrate-rig", copy / "rig.yaml")
    # Two pairs and the few shots that they are left with: saved, and judged as what it is.
    assert result.exit_code == 1, result.output
    assert "verdict: recalibrate" in result.output
    said = " ".join(result.output.split())
    for path in (missing, unreadable, resized, black, boardless):
        assert path.name in said
        assert path.parent.parent.name in said
    assert "100 x 100" in said
    assert "shows nothing" in said
    assert "no board found" in said
    assert sorted(load_calibration(copy / "calibration").pairs) == ["p1-2", "p2-2"]


def test_a_scan_of_another_image_size_is_refused(workspace: Workspace, copy: Path) -> None:
    for path in (copy / "captures" / "person").rglob("*.png"):
        path.write_bytes(path.read_bytes())
        small = cv2.resize(cv2.imread(str(path), 0), (320, 256))
        cv2.imwrite(str(path), small)
    result = run(
        "scan", copy / "captures" / "person", "--calibration", workspace.folder / "calibration"
    )
    assert result.exit_code != 0
    assert "320 x 256" in str(result.exception)


def test_a_scan_of_nobody_ends_in_a_verdict(workspace: Workspace, copy: Path) -> None:
    """All images black but for the lit ones' noise: no pair can be read, and the JSON says so."""
    for path in (copy / "captures" / "person").rglob("*.png"):
        cv2.imwrite(str(path), np.full_like(cv2.imread(str(path), 0), 12))
    arguments = (copy / "captures" / "person", "--calibration", workspace.folder / "calibration")
    result = run("scan", *arguments, "--out", copy / "scan")
    assert result.exit_code == 1
    verdict = json.loads((copy / "scan" / "scan.json").read_text())["verdict"]
    assert verdict["grade"] == "repeat"
    assert any("p1-2" in reason for reason in verdict["reasons"])
    with pytest.raises(ResultError, match="gave no model"):
        load_scan(copy / "scan")


def test_a_scan_without_a_pair_or_a_frame_goes_on_and_names_it(
    workspace: Workspace, copy: Path
) -> None:
    (copy / "captures" / "person" / "s01" / "p1-3" / "bit04-inverse.png").unlink()
    shutil.rmtree(copy / "captures" / "person" / "s01" / "p2-3")
    arguments = (copy / "captures" / "person", "--calibration", workspace.folder / "calibration")
    result = run("scan", *arguments, "--out", copy / "scan", *COARSER)
    assert result.exit_code == 0, result.output
    said = " ".join(result.output.split())
    for part in ("left out: p1-3", "bit04-inverse.png", "left out: p2-3"):
        assert part in said
    reasons = json.loads((copy / "scan" / "scan.json").read_text())["verdict"]["reasons"]
    assert any("p2-3" in reason for reason in reasons)
