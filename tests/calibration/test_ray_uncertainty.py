"""Where boards were, a pixel's ray is known; beyond, as badly as it is said to be."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from picture_boards import HEIGHT, MIDDLE, NOISE_PX, POINTS, WIDTH, calibrate_with_lenses

from bodyscan.calibration.board_views import PlanarView
from bodyscan.calibration.lens_selection import ChosenLens, estimate_ray_uncertainty
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses.lens import Lens
from bodyscan.geometry.lenses.opencv import Radial, Rational
from bodyscan.geometry.transforms import RigidTransform, twist_jacobian
from bodyscan.geometry.uncertainty import RayUncertainty, list_node_pixels

FOCAL = 1400.0  # 30 degrees from the axis to the corner
DEPTH_MM = 900.0


def calibrated(lens: Lens, reach: float, seed: int) -> tuple[Camera, ChosenLens]:
    """Boards whose middles are within `reach` of the axis, as tangents."""
    rng = np.random.default_rng(seed)
    true = Camera(FOCAL, FOCAL + 1.0, -0.5, 645.0, 508.0, lens, WIDTH, HEIGHT)
    views = []
    for k in range(14):
        turn = RigidTransform.from_rotation_vector(rng.normal(0.0, 0.35, 3), np.zeros(3)).rotation
        where = DEPTH_MM * np.array([*rng.uniform(-reach, reach, 2), 1.0])
        placed = RigidTransform(turn, where - turn @ MIDDLE).apply(POINTS)
        noisy = true.project(placed) + rng.normal(0.0, NOISE_PX, (len(POINTS), 2))
        views.append(PlanarView(f"s{k}", POINTS, noisy))
    return true, calibrate_with_lenses(views)


def errors_px(true: Camera, found: Camera, covered: float) -> np.ndarray:
    """(rows, columns), a coordinate's, less the motion that fits it best within `covered`."""
    pixels = list_node_pixels(WIDTH, HEIGHT)
    points = true.rays(pixels) * DEPTH_MM
    apart = found.project(points) - pixels
    flat = points.reshape(-1, 3)
    by_motion = found.jacobians(flat)[1] @ twist_jacobian(flat)
    near = np.all(np.abs(flat[:, :2]) < covered * DEPTH_MM, axis=1)
    motion = np.linalg.lstsq(
        by_motion[near].reshape(-1, 6), apart.reshape(-1, 2)[near].ravel(), rcond=None
    )[0]
    left = apart.reshape(-1, 2) - by_motion @ motion
    return np.sqrt(np.mean(left**2, axis=1)).reshape(pixels.shape[:2])


@pytest.mark.slow
def test_a_camera_seen_by_boards_in_its_middle_says_how_little_it_knows_of_its_rim() -> None:
    """A quarter of the picture is covered. Errors over their sigmas at the rim."""
    ratios = []
    for seed in range(6):
        lens = Radial(-0.25, 0.1) if seed % 2 else Rational(0.2, 0.05, 0.0, 0.0, 0.0, 0.5, 0.1, 0.0)
        true, found = calibrated(lens, 0.06, seed)
        sigma = found.rays.sigma_px
        rim = np.ones(sigma.shape, bool)
        rim[3:-3, 3:-3] = False
        assert np.median(sigma[rim]) > 20.0 * np.median(sigma[7:10, 9:12])
        ratios.append((errors_px(true, found.fit.camera, 0.18) / sigma)[rim])
    # A rim's errors go together: there are six of them, and these lenses are mild ones.
    assert 0.5 < np.sqrt(np.mean(np.square(ratios))) < 1.5


def test_boards_all_over_the_picture_know_it_all() -> None:
    true, found = calibrated(Radial(-0.25, 0.1), 0.35, 0)
    errors = errors_px(true, found.fit.camera, 0.35)
    # Corners err by 0.05 px, 980 of them; the picture's own corners are seen seldom.
    assert np.median(found.rays.sigma_px) < 0.1
    assert 0.2 < np.sqrt(np.mean((errors / found.rays.sigma_px) ** 2)) < 1.6


CHOSEN = Camera(FOCAL, FOCAL + 1.0, -0.5, 645.0, 508.0, Radial(-0.2, 0.08), WIDTH, HEIGHT)
K1 = CHOSEN.parameter_names.index("k1")
OFF = 1e-3


def told_by(richest: Camera, sigma_k1: float = 0.0, chosen: Camera = CHOSEN) -> RayUncertainty:
    """Of boards in two places, from a camera with such a lens of which k1 alone is open."""
    turns = ([0.3, 0.2, 0.0], [-0.2, 0.4, 0.1])
    poses = tuple(
        RigidTransform.from_rotation_vector(turn, [-100.0 + 60.0 * k, -80.0, DEPTH_MM])
        for k, turn in enumerate(turns)
    )
    covariance = np.zeros((7, 7))
    covariance[K1, K1] = sigma_k1**2
    fit: Any = SimpleNamespace(camera=richest, poses=poses, covariance=covariance)
    views = [PlanarView(f"s{k}", POINTS, POINTS[:, :2]) for k in range(2)]
    return estimate_ray_uncertainty(chosen, fit, views)


def test_a_lens_that_differs_moves_rays_off_the_axis() -> None:
    found = told_by(CHOSEN.retract(OFF * np.eye(7)[K1])).lens_px
    # A thousandth of r^3 at 30 degrees is a quarter of a pixel for a focal length of 1400.
    assert 0.05 < found.max() < 0.4
    assert found[8, 10] < 0.02 * found.max(), "near the axis a lens changes nothing"
    assert not told_by(CHOSEN).lens_px.any()


def test_a_sigma_of_a_coefficient_is_as_large_as_a_lens_that_differs_by_it() -> None:
    by_noise, by_lens = told_by(CHOSEN, OFF), told_by(CHOSEN.retract(OFF * np.eye(7)[K1]))
    # First order in a thousandth.
    np.testing.assert_allclose(
        by_noise.noise_px, by_lens.lens_px, atol=1e-3 * by_lens.lens_px.max()
    )
    assert not by_lens.noise_px.any()
    assert not by_noise.lens_px.any()


def test_where_a_lens_folds_rays_are_as_uncertain_as_the_worst_that_it_has() -> None:
    """r (1 - r^2 / 2) is 0.54 at most, less than the picture's corners are from its middle."""
    folding = Camera(FOCAL, FOCAL, 0.0, 645.0, 508.0, Radial(-0.5, 0.0), WIDTH, HEIGHT)
    found = told_by(folding.retract(1e-5 * np.eye(7)[K1]), 1e-5, folding)
    pixels = list_node_pixels(WIDTH, HEIGHT)
    away = np.linalg.norm((pixels - [645.0, 508.0]) / FOCAL, axis=-1)
    folds = away > np.sqrt(2.0 / 3.0) * 2.0 / 3.0
    assert folds[0, 0]
    assert folds.mean() < 0.2
    for told in (found.noise_px, found.lens_px):
        worst = told[~folds].max()
        assert 0.0 < worst < 0.1
        np.testing.assert_array_equal(told[folds], worst)
        assert np.median(told[~folds]) < 0.5 * worst
