"""The report of a calibration, and the map of sigma over the scan volume."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from ring import ring_of_cameras, ring_rig

from bodyscan.calibration.pair import PairCalibration, PairQuality
from bodyscan.errors import BadInput
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.camera_tables import is_in_image
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.geometry.uncertainty import PoseCovariance
from bodyscan.registration.calibration_verdict import grade_calibration
from bodyscan.registration.rig_calibration import ObservedCorners, RigCalibration
from bodyscan.registration.storage import load_calibration, save_calibration
from bodyscan.report.calibration_charts import (
    compute_sigma_at,
    count_shared_boards,
    draw_sigma_chart,
)
from bodyscan.report.calibration_page import make_calibration_page
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


def test_what_exceeds_a_limit_is_named_with_pair_and_value(calibration: RigCalibration) -> None:
    assert grade_calibration(calibration) == Verdict("good")
    boards = [board.model_copy(update={"square_mm": 7.0}) for board in calibration.rig.boards]
    rig = calibration.rig.model_copy(update={"boards": boards})
    verdict = grade_calibration(
        worse(replace(calibration, rig=rig), min(calibration.pairs), poses=1)
    )
    assert "square_mm is 7 mm" in verdict.reasons[0]  # before what is far worse
    failed = {"c9": "saw nothing (bit 0)", "d4": "is late", "c8": "saw nothing (2 of 3 bits)"}
    verdict = grade_calibration(replace(calibration, failed=failed))
    reasons = ("failed: c9, c8: saw nothing (bit 0)", "failed: d4: is late")
    assert verdict == Verdict("usable", reasons)
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
    together = count_shared_boards(calibration)
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
    text = render(make_calibration_page(tmp_path))
    assert text == render(make_calibration_page(tmp_path))
    for part in ("Verdict: usable", "c9: saw nothing", "<li>n1</li>", "<li>a1</li>"):
        assert part in text


def test_a_calibration_of_before_has_a_report_too(
    calibration: RigCalibration, tmp_path: Path
) -> None:
    save_calibration(replace(calibration, observed={}), tmp_path)
    text = render(make_calibration_page(tmp_path))
    assert "calibrate again to see where the boards lay" in text
    assert "Sigma over the scan volume" in text


GOOD = PairQuality(0.05, 9)
MIDDLE = np.array([[0.0, 0.0, 1000.0]])


def shifts(names: dict[str, RigidTransform], mm: float) -> PoseCovariance:
    """Every pair shifted by itself, `mm` along each axis, not turned."""
    own = np.diag([0.0, 0.0, 0.0, *[mm**2] * 3])
    return PoseCovariance(tuple(names), np.kron(np.eye(len(names)), own).astype(float))


def calibrated(
    placings: dict[str, RigidTransform],
    cameras: dict[str, Camera],
    covariance: PoseCovariance,
    quality: PairQuality = GOOD,
) -> RigCalibration:
    """Cameras without projectors."""
    pairs = {
        name: PairCalibration(name, cameras[name], np.eye(7), None, quality) for name in placings
    }
    return RigCalibration(ring_rig(placings), pairs, placings, covariance, {}, {}, ())


def test_independent_shifts_average_out_and_shifts_in_common_do_not() -> None:
    placings, cameras = ring_of_cameras(heights=(1000,))
    sigma, seen = compute_sigma_at(MIDDLE, placings, cameras, shifts(placings, 0.3), ())
    assert seen[0] == 3
    assert sigma[0] == pytest.approx(0.3 * np.sqrt(3) / np.sqrt(3))  # three axes, three pairs
    own = np.diag([0.0, 0.0, 0.0, *[0.3**2] * 3])
    together = PoseCovariance(tuple(placings), np.kron(np.ones((3, 3)), own).astype(float))
    sigma, _ = compute_sigma_at(MIDDLE, placings, cameras, together, ())
    assert sigma[0] == pytest.approx(0.3 * np.sqrt(3))


def test_sigma_is_that_of_drawn_placings() -> None:
    placings, cameras = ring_of_cameras(heights=(900, 1300))
    names = tuple(placings)
    rng = np.random.default_rng(1)
    # Turns of 1e-4 radians about the rig's origin and shifts of 0.1 mm, all correlated.
    mixing = rng.normal(size=(36, 36)) / 6.0 * np.tile([1e-4] * 3 + [0.1] * 3, 6)[:, None]
    points = rng.uniform([-300, -300, 700], [300, 300, 1500], (20, 3))
    covariance = PoseCovariance(names, mixing @ mixing.T)
    sigma, seen = compute_sigma_at(points, placings, cameras, covariance, names)
    sights = np.array([is_in_image(cameras[n], placings[n].inverse().apply(points)) for n in names])
    assert np.array_equal(sights.sum(axis=0), seen)
    squared = np.zeros(len(points))
    for draw in rng.normal(size=(800, 36)):
        motions = (mixing @ draw).reshape(6, 6)
        moved = np.array(
            [placings[n].retract(m).apply(placings[n].inverse().apply(points)) - points
             for n, m in zip(names, motions, strict=True)]
        )  # fmt: skip
        mean = np.sum(moved * sights[..., None], axis=0) / np.maximum(seen, 1)[:, None]
        squared += np.sum(mean**2, axis=1)
    drawn = np.sqrt(squared / 800)
    # 800 draws of 3 axes tell a sigma to 2 or 3 % if one axis leads; three such.
    assert np.all(seen > 0)
    np.testing.assert_allclose(sigma, drawn, rtol=0.1)


def test_what_no_pair_sees_has_no_sigma() -> None:
    placings, cameras = ring_of_cameras(heights=(400,))
    own, above = shifts(placings, 0.3), np.array([[0.0, 0.0, 2100.0]])
    sigma, seen = compute_sigma_at(above, placings, cameras, own, placings)
    assert seen[0] == 0
    assert np.isnan(sigma[0])
    drawn, again = (draw_sigma_chart(calibrated(placings, cameras, own)) for _ in range(2))
    assert drawn == again
    picture = cv2.imdecode(np.frombuffer(drawn, np.uint8), cv2.IMREAD_COLOR)
    height, width = picture.shape[:2]
    assert height == 900
    # Two maps of 700 mm about the axis: unseen grey above, a colour where three cameras look.
    for column in (int(0.25 * width), int(0.65 * width)):
        assert picture[100, column].tolist() == [199, 199, 199]
        assert np.ptp(picture[650, column].astype(int)) > 50


def test_a_camera_measures_depth_only_with_another_or_with_its_projector() -> None:
    placings, cameras = ring_of_cameras(poles=1, heights=(1000,))
    own = shifts(placings, 0.3)
    sigma, seen = compute_sigma_at(MIDDLE, placings, cameras, own, ())
    assert seen[0] == 1
    assert np.isnan(sigma[0])
    sigma, _ = compute_sigma_at(MIDDLE, placings, cameras, own, placings)
    assert sigma[0] == pytest.approx(0.3 * np.sqrt(3))


def test_no_map_is_drawn_of_what_is_not_known() -> None:
    placings, cameras = ring_of_cameras(heights=(400,))
    unknown = PairQuality(None, 0, imported="foreign.yaml")
    calibration = calibrated(placings, cameras, shifts(placings, 0.3), unknown)
    with pytest.raises(
        BadInput, match=r"accuracy of the imported calibration of p1-1, p2-1, p3-1 is not known"
    ) as caught:
        draw_sigma_chart(calibration)
    assert "--sigma-px" in caught.value.remedy
    one = {"p1-1": placings["p1-1"]}
    with pytest.raises(BadInput, match="no pose uncertainty to map"):
        draw_sigma_chart(calibrated(one, cameras, shifts(one, 0.0)))
