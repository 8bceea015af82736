"""The first example, on the small workspace."""

from __future__ import annotations

import runpy
from pathlib import Path

import pytest
from small_workspace import PROJECT, Workspace, copy_pairs

import bodyscan


def test_calibrate_and_scan(
    workspace: Workspace, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One pair of each pole: lower body from one side, upper from the other."""
    folder = tmp_path / "pole"
    copy_pairs(workspace.folder, ("p1-2", "p2-3"), folder)
    example = runpy.run_path(str(PROJECT / "examples" / "calibrate_and_scan.py"))
    example["main"](folder, tmp_path)
    said = capsys.readouterr().out
    assert "verdict: " in said
    assert "mm by tape" in said
    assert (tmp_path / "export" / "body.glb").stat().st_size > 10_000
    stored = bodyscan.load_scan(tmp_path / "person")
    assert 1500 < bodyscan.measure(stored).stature_mm < 1800
    calibration = bodyscan.load_calibration(tmp_path / "calibration")
    images = bodyscan.triangulate(folder / "captures" / "person", calibration)
    assert {image.pair for image in images.value} == set(calibration.pairs)
    assert not images.failures
