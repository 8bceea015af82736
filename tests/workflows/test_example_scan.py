"""The first example, on the small workspace."""

from __future__ import annotations

from pathlib import Path

import bodyscan


def test_calibrate_and_scan(example: Path) -> None:
    said = (example / "said.txt").read_text("utf-8")
    assert "verdict: " in said
    assert "mm by tape" in said
    assert (example / "made" / "export" / "body.glb").stat().st_size > 10_000
    stored = bodyscan.load_scan(example / "made" / "person")
    assert 1500 < bodyscan.measure(stored).stature_mm < 1800
    calibration = bodyscan.load_calibration(example / "made" / "calibration")
    images = bodyscan.triangulate(example / "pole" / "captures" / "person", calibration)
    assert {image.pair for image in images.value} == set(calibration.pairs)
    assert not images.failures
