"""One camera from its boards: what least squares start from, and what they find."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import nullcontext

import numpy as np
import pytest
from table_one import CAMERA, POINTS, TURNS

from bodyscan.arrays import Array
from bodyscan.calibration.board_views import PlanarView
from bodyscan.calibration.camera import calibrate_camera, estimate_pose, locate_board
from bodyscan.calibration.sheet_fit import fit_pinhole
from bodyscan.errors import DegeneratePoses
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses.opencv import Radial
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


def test_pure_translation_and_two_poses_are_refused() -> None:
    with pytest.raises(DegeneratePoses, match="translation only"):
        calibrate_camera(views([TURNS[0]] * 4, 0.03), 640, 480)
    with pytest.raises(DegeneratePoses, match="2 usable board poses"):
        calibrate_camera(views(TURNS[:2]), 640, 480)


@pytest.mark.parametrize("plane_z", [0.0, 6.0])
def test_a_board_is_located_from_either_face(plane_z: float) -> None:
    points = POINTS + np.array([0.0, 0.0, plane_z])
    pose = RigidTransform.from_rotation_vector([0.3, np.pi * (plane_z > 0), 0.1], [60, -70, 420.0])
    view = PlanarView("s", points, CAMERA.project(pose.apply(points)))
    found, residuals = locate_board(CAMERA, view)
    assert np.allclose(found.matrix, pose.matrix, atol=1e-6)
    assert np.max(np.abs(residuals)) < 1e-6


WIDTH, HEIGHT = 1280, 1024
GRID = np.stack(np.meshgrid(30.0 * np.arange(9), 30.0 * np.arange(6)), axis=-1).reshape(-1, 2)


def posed(*turn: float, z: float = 700.0) -> RigidTransform:
    pose = RigidTransform.from_rotation_vector(turn, [0.0, 0.0, 0.0])
    middle = np.array([120.0, 75.0, 0.0])
    return RigidTransform(pose.rotation, [20.0, -10.0, z] - pose.rotation @ middle)


POSES = [
    posed(0.4, 0.1, 0.2),
    posed(-0.3, 0.35, -0.5),
    posed(0.1, -0.45, 1.0),
    posed(-0.4, -0.2, 0),
]


def seen(matrix: np.ndarray, pose: RigidTransform, plane_z: float = 0.0) -> PlanarView:
    points = np.column_stack([GRID, np.full(len(GRID), plane_z)])
    ahead = pose.apply(points) @ matrix.T
    return PlanarView("", points, ahead[:, :2] / ahead[:, 2:])


def matrix(alpha: float, beta: float, gamma: float, u0: float, v0: float) -> np.ndarray:
    return np.array([[alpha, gamma, u0], [0.0, beta, v0], [0.0, 0.0, 1.0]])


USUAL = matrix(1500.0, 1480.0, 4.0, 655.0, 500.0)


def test_planes_that_turn_by_less_than_three_degrees_are_one_plane() -> None:
    for degrees, refused in ((2.5, True), (3.6, False)):
        turns = (0.3, 0.3, 0.3 + np.radians(degrees))
        poses = [posed(turn, 0.1, 0.0, z=800.0 + 50.0 * k) for k, turn in enumerate(turns)]
        views = [seen(matrix(1536, 1536, 0, 640, 512), pose) for pose in poses]
        wrong = pytest.raises(DegeneratePoses, match="the 3 board poses differ by a translation")
        with wrong if refused else nullcontext():
            calibrate_camera(views, WIDTH, HEIGHT)


@pytest.mark.parametrize(
    "true",
    [
        USUAL,
        matrix(1200.0, 880.0, -80.0, 360.0, 800.0),
        matrix(1500.0, 800.0, 0.0, 640.0, 512.0),  # every second line of a picture
        matrix(750.0, 1600.0, 0.0, 640.0, 512.0),
        matrix(1500.0, 1500.0, 160.0, 640.0, 512.0),  # skew of a tenth
        matrix(1500.0, 1500.0, 0.0, 1270.0, 512.0),  # half of the width off the middle
    ],
)
def test_any_camera_is_found_from_a_start_with_its_axis_in_the_middle(true: np.ndarray) -> None:
    for count in (3, 4):
        found = calibrate_camera([seen(true, pose) for pose in POSES[:count]], WIDTH, HEIGHT).camera
        np.testing.assert_allclose(found.matrix, true, rtol=1e-6, atol=1e-4)


@pytest.mark.parametrize("pose", POSES)
@pytest.mark.parametrize("plane_z", [0.0, 6.0])
def test_a_boards_pose_follows_from_its_corners(pose: RigidTransform, plane_z: float) -> None:
    camera = Camera(1500.0, 1480.0, 4.0, 655.0, 500.0, Radial(), WIDTH, HEIGHT)
    found = estimate_pose(camera, seen(USUAL, pose, plane_z))
    np.testing.assert_allclose(found.matrix, pose.matrix, atol=1e-4)


def test_a_projector_without_lens_is_found_from_its_stripes() -> None:
    true = np.array([[3.0, 0.2, 0.9, 120.0], [0.1, -0.05, 1.0, 60.0]])
    true /= np.linalg.norm(true[1, :3])
    rng = np.random.default_rng(0)
    points = rng.uniform([-200, -200, 700], [200, 200, 1100], (400, 3))
    above, below = (points @ true[:, :3].T + true[:, 3]).T
    s = above / below
    np.testing.assert_allclose(fit_pinhole(points, s), true, rtol=1e-5, atol=1e-5)
    assert below.min() > 0.0, "it shines forward"
    # One in ten is off by 0.7: plainly they would pull the others by 0.07 in the mean.
    wrong = s + np.where(np.arange(400) % 10 == 0, 0.7, 0.0) + 1e-4 * rng.normal(size=400)
    above, below = fit_pinhole(points, wrong) @ np.column_stack([points, np.ones(400)]).T
    assert np.mean(np.abs(above / below - s)) < 0.035
