"""The report of a calibration with known faults: what it says of them, and what it draws."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ring import ring_of_cameras, ring_rig

from bodyscan.calibration.pair import PairCalibration, PairQuality
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.geometry.uncertainty import PoseCovariance
from bodyscan.registration.calibration_verdict import grade_calibration
from bodyscan.registration.rig_calibration import ObservedCorners, RigCalibration
from bodyscan.registration.storage import load_calibration, save_calibration
from bodyscan.report.calibration_charts import shared_boards
from bodyscan.report.calibration_page import calibration_page
from bodyscan.report.page import render
from bodyscan.verdict import Verdict

SIGMA_MM = np.array([0.01, 0.02, 0.05])
SHOTS = {("b1", "board"): 0, ("b2", "board"): 1, ("b3", "board"): 2}


def corners(camera: Camera, targets: list[int], share: float = 0.9) -> ObservedCorners:
    """A grid over so much of the picture's width and height, in each of the shots."""
    x, y = np.meshgrid(np.linspace(0.5 - share / 2, 0.5 + share / 2, 9), np.linspace(0.1, 0.9, 7))
    pixels = np.stack([x.ravel() * camera.width, y.ravel() * camera.height], axis=1)
    residuals = np.random.default_rng(1).normal(0.0, 0.05, (len(targets) * len(pixels), 2))
    return ObservedCorners(
        np.tile(pixels, (len(targets), 1)).astype(np.float32),
        residuals.astype(np.float32),
        np.repeat(targets, len(pixels)).astype(np.int16),
    )


@pytest.fixture
def calibration() -> RigCalibration:
    """A ring of cameras, each known apart from the others, without rotation, by SIGMA_MM."""
    placings, cameras = ring_of_cameras(heights=(700, 1200))
    pairs = {
        name: PairCalibration(
            name, camera, np.eye(len(camera.parameters)), None, PairQuality(0.05, 9)
        )
        for name, camera in cameras.items()
    }
    one = np.diag([0.0, 0.0, 0.0, *SIGMA_MM**2])
    covariance = PoseCovariance(tuple(pairs), np.kron(np.eye(len(pairs)), one).astype(float))
    boards = {target: RigidTransform.identity() for target in SHOTS}
    seen = {
        name: corners(camera, [0, 1] if k else [1, 2])
        for k, (name, camera) in enumerate(cameras.items())
    }
    return RigCalibration(
        ring_rig(placings), pairs, placings, covariance, boards, {}, ("n1",), ("a1",), seen
    )


def worse(calibration: RigCalibration, name: str, **changes: Any) -> RigCalibration:
    pair = calibration.pairs[name]
    quality = replace(pair.quality, **changes)
    return replace(calibration, pairs=calibration.pairs | {name: replace(pair, quality=quality)})


def test_what_exceeds_a_limit_is_named_with_pair_value_and_limit(
    calibration: RigCalibration,
) -> None:
    assert grade_calibration(calibration) == Verdict("good")
    verdict = grade_calibration(replace(calibration, failed={"c9": "saw nothing"}))
    assert verdict == Verdict("usable", ("pair c9 failed: saw nothing",))
    name = min(calibration.pairs)
    verdict = grade_calibration(worse(calibration, name, corners_rms_px=0.4))
    assert verdict.grade == "usable"
    assert verdict.reasons == (
        f"pair {name}: corner residuals are 0.4 px RMS (at most 0.3 is good)",
    )
    verdict = grade_calibration(worse(calibration, name, corners_rms_px=0.7, poses=5))
    assert verdict.grade == "recalibrate"
    assert verdict.reasons[0].startswith(f"recalibrate: pair {name}: corner residuals are 0.7 px")
    assert "5 board poses (at least 6 is good)" in verdict.reasons[1]


def test_a_picture_that_boards_hardly_cover_is_named(calibration: RigCalibration) -> None:
    name = min(calibration.pairs)
    narrow = corners(calibration.pairs[name].camera, [0, 1], share=0.3)
    verdict = grade_calibration(
        replace(calibration, observed=calibration.observed | {name: narrow})
    )
    assert verdict.grade == "usable"
    # 30 % of the width and 80 % of the height.
    assert f"pair {name}: boards covered 2" in verdict.reasons[0]


def test_boards_in_common_are_counted_shot_by_shot(calibration: RigCalibration) -> None:
    together = shared_boards(calibration)
    assert together[0, 1] == together[1, 0] == 1
    assert together[1, 2] == 2
    assert np.all(np.diag(together) == 0)


@pytest.mark.slow
def test_everything_is_said_and_read_back_from_disk(
    calibration: RigCalibration, tmp_path: Path
) -> None:
    failed = replace(calibration, failed={"c9": "saw nothing"})
    save_calibration(failed, tmp_path)
    stored = load_calibration(tmp_path)
    for name, seen in calibration.observed.items():
        assert np.array_equal(stored.observed[name].pixels, seen.pixels)
        assert np.array_equal(stored.observed[name].target, seen.target)
    text = render(calibration_page(tmp_path))
    assert text == render(calibration_page(tmp_path))
    for part in ("Verdict: usable", "c9: saw nothing", "<li>n1</li>", "<li>a1</li>"):
        assert part in text


def test_a_calibration_of_before_has_a_report_too(
    calibration: RigCalibration, tmp_path: Path
) -> None:
    save_calibration(replace(calibration, observed={}), tmp_path)
    text = render(calibration_page(tmp_path))
    assert "calibrate again to see where the boards lay" in text
    assert "Sigma over the scan volume" in text
