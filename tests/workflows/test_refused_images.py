"""Cameras that fail are told the cause once, without any folder's name: images, or a board's words."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from small_workspace import run

from bodyscan.captures.folder import open_captures
from bodyscan.errors import CaptureError, FailedWork, ScanFailed
from bodyscan.rig.rig import load_rig
from bodyscan.workflows.calibrate_rig import calibrate_rig
from bodyscan.workflows.find_boards import find_all_boards

RIG = """
version: 1
name: two
boards:
  - {name: board, columns: 9, rows: 7, square_mm: 30}
pairs:
  - {name: L, camera: {width: 64, height: 48}}
  - {name: R, camera: {width: 64, height: 48}}
calibration:
  - folder: .
files: "{pair}{shot}.png"
"""
SHOTS = 4
BLANK = np.full((48, 64), 100.0)


def refusal(folder: Path, left: NDArray[Any], right: NDArray[Any]) -> str:
    """What is said of a rig whose cameras took these pictures in every shot."""
    (folder / "rig.yaml").write_text(RIG, "utf-8")
    for shot in range(SHOTS):
        cv2.imwrite(str(folder / f"L{shot}.png"), left)
        cv2.imwrite(str(folder / f"R{shot}.png"), right)
    rig = load_rig(folder / "rig.yaml")
    with pytest.raises(FailedWork) as caught:
        calibrate_rig(rig, open_captures(rig, folder / "rig.yaml"), folder=folder)
    return str(caught.value)


def test_images_that_cannot_be_used_are_the_reason_not_the_board(tmp_path: Path) -> None:
    eight_in_sixteen = BLANK.astype(np.uint16)
    said = refusal(tmp_path, eight_in_sixteen, eight_in_sixteen)
    assert "L: 4 of its 4 images cannot be used" in said
    assert "R: 4 of its 4 images cannot be used" in said
    assert said.count("bits: 8") == 1  # the remedy, once
    assert "more poses" not in said
    assert "found in none" not in said


def test_a_camera_whose_images_have_another_size_is_told_so(tmp_path: Path) -> None:
    said = refusal(tmp_path, np.zeros((24, 32), np.uint8), BLANK.astype(np.uint8))
    assert "L: 4 of its 4 images cannot be used" in said
    assert "is 32 x 24 pixels, but the rig file says 64 x 48" in said
    assert "camera's width and height" in said
    assert "found in none of 4 images" in said  # those of R alone were searched


def test_what_images_show_instead_of_a_board_is_said_once(tmp_path: Path) -> None:
    blank = BLANK.astype(np.uint8)
    said = refusal(tmp_path, blank, blank)
    assert "found in none of 8 images" in said
    assert said.count("no board found") == 1
    assert "more poses" not in said
    rig = load_rig(tmp_path / "rig.yaml")
    notes = find_all_boards(rig, open_captures(rig, tmp_path / "rig.yaml")).notes
    folded = ": no board found in 4 of 4 images, shots 0, 1, 2, 3"
    assert [note.partition(";")[0] for note in notes] == ["L" + folded, "R" + folded]


STORED = Path(__file__).parents[1] / "data" / "stored-0.1.0" / "calibration"
PAIRS = ("p1-2", "p1-3", "p2-2", "p2-3")


def failed_scan(folder: Path) -> bytes:
    """scan.json of captures whose images are all damaged or missing."""
    for pair in PAIRS:
        image = folder / "captures" / "person" / pair / "bit00.png"
        image.parent.mkdir(parents=True)
        image.write_bytes(b"no image")
    result = run("scan", folder / "captures", "--calibration", STORED, "--out", folder / "made")
    assert isinstance(result.exception, ScanFailed)
    return (folder / "made" / "scan.json").read_bytes()


def test_a_scan_of_damaged_images_is_told_by_their_names_alone(tmp_path: Path) -> None:
    kept = failed_scan(tmp_path / "anna.miller")
    assert b"p2-3: person/p1-2/lit.png (pair p1-2" in kept  # alike in four pairs: said once
    assert kept.count(b"Copy it again from where it was taken") <= 1  # of four pairs
    assert b"anna" not in kept
    assert str(tmp_path).encode() not in kept
    assert failed_scan(tmp_path / "b" / "elsewhere") == kept


def test_links_out_of_the_folder_are_followed_when_that_is_said(tmp_path: Path) -> None:
    (tmp_path / "all.png").write_bytes(b"no image")
    for pair in PAIRS:
        image = tmp_path / "captures" / "person" / pair / "bit00.png"
        image.parent.mkdir(parents=True)
        image.symlink_to(tmp_path / "all.png")
    command = ("scan", tmp_path / "captures", "--calibration", STORED)
    refused = run(*command).exception
    assert isinstance(refused, CaptureError)
    assert "--follow-links" in refused.remedy
    assert isinstance(run(*command, "--follow-links").exception, ScanFailed)  # the images were read
