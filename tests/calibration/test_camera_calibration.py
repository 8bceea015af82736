from collections.abc import Iterable, Sequence

import numpy as np
import pytest
from table_one import CAMERA, POINTS, TURNS

from bodyscan.arrays import Array
from bodyscan.calibration.board_views import PlanarView
from bodyscan.calibration.camera import calibrate_camera, locate_board
from bodyscan.errors import DegeneratePoses
from bodyscan.geometry.transforms import RigidTransform


def views(
    turns: Iterable[Array | Sequence[float]], noise_px: float = 0.0, seed: int = 0
) -> list[PlanarView]:
    rng = np.random.default_rng(seed)
    found = []
    for k, turn in enumerate(turns):
        pose = RigidTransform.from_rotation_vector(turn, [-90.0, -70.0, 400.0 + 20.0 * k])
        pixels = CAMERA.project(pose.apply(POINTS)) + rng.normal(0.0, noise_px, (48, 2))
        found.append(PlanarView(f"s{k}", POINTS, pixels))
    return found


def test_three_noiseless_poses_give_table_1_back() -> None:
    found = calibrate_camera(views(TURNS), 640, 480).camera
    # Without noise only rounding is left: 1e-5 px, 1e-7 in k.
    assert found.parameters == pytest.approx(CAMERA.parameters, rel=1e-6, abs=1e-5)


def test_sigmas_are_honest() -> None:
    # 40 draws of 0.03 px noise: errors over sigmas have a spread of 1 +- 0.11 (1 / sqrt(2 * 40)),
    # and the estimate of the noise itself adds a few percent: 0.7 to 1.3 is three sigmas.
    errors = []
    for seed in range(40):
        result = calibrate_camera(views(TURNS, 0.03, seed), 640, 480)
        sigmas = np.sqrt(np.diag(result.covariance))
        errors.append((result.camera.parameters - CAMERA.parameters) / sigmas)
    spread = np.sqrt(np.mean(np.square(errors), axis=0))
    assert np.all((spread > 0.7) & (spread < 1.3)), spread


def test_an_outlier_corner_does_no_harm() -> None:
    disturbed = views(TURNS, 0.03)
    disturbed[1].pixels[10] += [5.0, -4.0]
    found = calibrate_camera(disturbed, 640, 480).camera
    clean = calibrate_camera(views(TURNS, 0.03), 640, 480).camera
    # The clean solution's own sigma of alpha is about 0.5 px.
    assert abs(found.alpha - clean.alpha) < 0.5


def test_two_poses_are_refused() -> None:
    with pytest.raises(DegeneratePoses, match="2 usable board poses"):
        calibrate_camera(views(TURNS[:2]), 640, 480)


def test_pure_translation_is_refused() -> None:
    with pytest.raises(DegeneratePoses, match="translation only"):
        calibrate_camera(views([TURNS[0]] * 4, 0.03), 640, 480)


@pytest.mark.parametrize("plane_z", [0.0, 6.0])
def test_a_board_is_located_from_either_face(plane_z: float) -> None:
    points = POINTS + np.array([0.0, 0.0, plane_z])
    pose = RigidTransform.from_rotation_vector([0.3, np.pi * (plane_z > 0), 0.1], [60, -70, 420.0])
    view = PlanarView("s", points, CAMERA.project(pose.apply(points)))
    found, residuals = locate_board(CAMERA, view)
    assert np.allclose(found.matrix, pose.matrix, atol=1e-6)
    assert np.max(np.abs(residuals)) < 1e-6
