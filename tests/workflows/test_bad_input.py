"""What goes wrong costs that image or that pair, is named, and never the whole run."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from small_workspace import COARSER, Workspace, copy_pairs, run

from bodyscan.arrays import Array
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


def changed(shot: Path, change: Callable[[Array], Array], names: str = "*/*") -> None:
    """Change the grey levels of images of a scan."""
    for path in shot.glob(f"{names}.png"):
        grey = change(cv2.imread(str(path), 0).astype(float))
        cv2.imwrite(str(path), np.clip(np.rint(grey), 0, 255).astype(np.uint8))


def delete(shot: Path, names: str) -> None:
    for path in shot.glob(f"{names}.png"):
        path.unlink()


def one_late(shot: Path) -> None:
    frames = ["lit", "dark", *(f"bit{n:02d}{k}" for n in range(7) for k in ("", "-inverse"))]
    for pair in shot.iterdir():
        taken = [(pair / f"{frame}.png").read_bytes() for frame in ("dark", *frames[:-1])]
        for frame, content in zip(frames, taken, strict=True):
            (pair / f"{frame}.png").write_bytes(content)


FAULTS: dict[str, tuple[Callable[[Path], None], str, str]] = {
    "all overexposed": (lambda s: changed(s, lambda i: 4.0 * i), "repeat", "are overexposed"),
    "all dark": (lambda s: changed(s, lambda i: 0.12 * i), "usable", "the images are dark"),
    "nobody": (lambda s: changed(s, lambda i: 0.0 * i + 12.0), "repeat", "p1-2, p1-3, p2-2, p2-3: "),
    "a pole lost": (lambda s: delete(s, "p2-*/*"), "repeat", "left out: p2-2, p2-3: .*is missing"),
    "a frame lost": (lambda s: delete(s, "p1-3/bit04-i*"), "usable", "p1-3: .*bit04-inverse"),
    "frames one late": (one_late, "repeat", "out of step by 1: each file holds that 1 before its own"),
    "a projector off": (
        lambda s: changed(s, lambda i: 0.0 * i + 12.0, "p2-2/*"), "usable", "out: p2-2: .*lights only"),
    "upside down": (
        lambda s: changed(s, lambda i: i[::-1, ::-1], "p2-2/*"), "repeat", "p2-2 .*upside down"),
}  # fmt: skip


@pytest.mark.parametrize("name", FAULTS)
def test_the_first_reason_is_the_cause(workspace: Workspace, tmp_path: Path, name: str) -> None:
    damage, grade, words = FAULTS[name]
    shutil.copytree(workspace.folder / "captures" / "person", tmp_path / "person")
    damage(tmp_path / "person" / "s01")
    at = ("--calibration", workspace.folder / "calibration")
    result = run("scan", tmp_path / "person", *at, "--out", tmp_path / "scan", *COARSER)
    verdict = json.loads((tmp_path / "scan" / "scan.json").read_text())["verdict"]
    assert re.search(words, verdict["reasons"][0].partition("\n")[0]), verdict
    assert verdict["grade"] == grade, verdict
    assert result.exit_code == (grade == "repeat")
