"""A person rendered by an independent program (BODYSCAN_PEOPLE), scanned by the real command."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from required import missing
from small_workspace import PROJECT, run

from benchmarks.independent_people import load_truth, measure_rms_without_hair
from bodyscan.fusion.storage import load_scan


@pytest.mark.slow
def test_the_cloud_of_the_woman_lies_on_the_true_body(tmp_path: Path) -> None:
    people = Path(os.environ.get("BODYSCAN_PEOPLE", PROJECT.parent / "shared" / "people"))
    if not (people / "woman").is_dir():
        missing(f"people not found at {people} (set BODYSCAN_PEOPLE)")
    woman, out = people / "woman", tmp_path / "model"
    run("scan", woman / "scan", "--calibration", woman / "calibration", "--out", out)
    points = load_scan(out).cloud.points
    some = np.random.default_rng(0).choice(len(points), min(len(points), 100_000), replace=False)
    # It is 0.17 mm.
    truth = load_truth(woman / "truth")
    assert measure_rms_without_hair(points[some].astype(float), truth) < 0.20
