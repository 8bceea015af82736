"""Cameras that fail are told the cause once: images that cannot be used, or the board's description."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from bodyscan.captures.folder import open_captures
from bodyscan.errors import FailedWork
from bodyscan.rig.rig import load_rig
from bodyscan.workflows.calibrate_rig import calibrate_rig

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
