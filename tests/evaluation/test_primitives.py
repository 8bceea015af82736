"""Spheres and plates whose truth is known: fits, Eq. 19, and how flat a plate is but for noise."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bodyscan.arrays import Array
from bodyscan.errors import FailedWork
from bodyscan.evaluation.primitives import (
    Sphere,
    compare_centre_distances,
    compute_mean_square_distance,
    find_spheres,
    fit_plane,
    fit_polynomial,
    fit_sphere,
    measure_flatness,
    measure_sphere,
)
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.reconstruction.triangulation import estimate_grid_normals

CENTRES = np.array(
    [[-73, -50, 405], [-11, -50, 405], [51, -50, 405], [-42, 8, 385], [20, 8, 385.0]]
)


def cap(
    centre: Array, radius: float, count: int = 2000, noise: float = 0.0, seed: int = 0
) -> np.ndarray:
    """Points on the side that faces the camera, within 60 degrees of the way to it."""
    rng = np.random.default_rng(seed)
    height, turn = rng.uniform(0.5, 1.0, count), rng.uniform(0.0, 2.0 * np.pi, count)
    wide = np.sqrt(1.0 - height**2)
    arms = np.stack([wide * np.cos(turn), wide * np.sin(turn), -height], axis=1)
    return centre + arms * (radius + noise * rng.standard_normal(count))[:, None]


@settings(max_examples=30, deadline=None)
@given(
    x=st.floats(-100.0, 100.0),
    z=st.floats(200.0, 2000.0),
    radius=st.floats(5.0, 200.0),
    seed=st.integers(0, 1000),
)
def test_an_exact_cap_gives_its_sphere(x: float, z: float, radius: float, seed: int) -> None:
    centre = np.array([x, -30.0, z])
    points = cap(centre, radius, seed=seed)
    free, held = fit_sphere(points), fit_sphere(points, radius)
    # Rounding of coordinates of 2000 mm, squared in the start and refined from there.
    assert np.allclose(free.centre, centre, atol=1e-5)
    assert free.radius == pytest.approx(radius, abs=1e-5)
    assert np.allclose(held.centre, centre, atol=1e-6)
    assert held.radius == radius
    assert compute_mean_square_distance(points, free) < 1e-9


def test_eq_19_is_the_noise_squared() -> None:
    noise = 0.02
    found = measure_sphere(cap(CENTRES[0], 25.0, 20000, noise), 25.0)
    # Variance of 20000 draws: 1 percent; the fits take up 4 of 20000 freedoms.
    assert found.e_given == pytest.approx(noise**2, rel=0.04)
    assert found.e_fitted == pytest.approx(noise**2, rel=0.04)
    # A cap of 60 degrees determines its radius about 10 sigma / sqrt(N).
    assert found.fitted.radius == pytest.approx(25.0, abs=0.005)


def test_a_given_radius_shows_what_a_fitted_one_hides() -> None:
    found = measure_sphere(cap(CENTRES[0], 25.5), 25.0)
    assert found.fitted.radius == pytest.approx(25.5, abs=1e-5)
    assert found.e_fitted < 1e-9
    # The centre takes up part of 0.5 mm: what is left varies over the cap.
    assert 1e-3 < found.e_given < 0.25


def test_outliers_do_not_pull_the_fit_but_count_in_e() -> None:
    points = cap(CENTRES[0], 25.0, 5000, 0.01)
    points[::100, 2] += 5.0
    found = measure_sphere(points, 25.0)
    assert np.linalg.norm(found.given.centre - CENTRES[0]) < 0.01
    # Known ten times less well together.
    assert np.linalg.norm(found.fitted.centre - CENTRES[0]) < 0.02
    assert found.fitted.radius == pytest.approx(25.0, abs=0.02)
    # A hundredth of the points, some 4 mm off the sphere.
    assert 0.05 < found.e_given < 0.3


def test_too_few_points_are_refused() -> None:
    with pytest.raises(FailedWork, match="too few"):
        fit_sphere(cap(CENTRES[0], 25.0, 20))
    points = np.random.default_rng(0).normal(size=(50, 3))
    points *= 30.0 / np.linalg.norm(points, axis=1, keepdims=True)
    assert fit_sphere(points).radius == pytest.approx(30.0)
    with pytest.raises(FailedWork, match="49 points are too few for a sphere"):
        fit_sphere(points[:49])


def range_image(noise: float = 0.0) -> np.ndarray:
    """(H, W, 3): five balls on a slanting ground, seen from the origin, every second pixel."""
    u, v = np.meshgrid(np.arange(0.0, 640.0, 2.0), np.arange(0.0, 480.0, 2.0))
    rays = np.stack([(u - 350.0) / 1062.0, (v - 287.0) / 1064.0, np.ones_like(u)], axis=-1)
    depth = 25.0 * 17.6 / (1.0 + 0.33 * rays[..., 1])
    square = np.sum(rays**2, axis=-1)
    for centre in CENTRES:
        along = rays @ centre
        root = along**2 - square * (centre @ centre - 25.0**2)
        ball = (along - np.sqrt(np.maximum(root, 0.0))) / square
        depth = np.where((root > 0) & (ball < depth), ball, depth)
    depth = depth + noise * np.random.default_rng(0).standard_normal(depth.shape)
    return rays * depth[..., None]


@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_spheres_are_found_in_reading_order(noise: float) -> None:
    points = range_image(noise)
    normals = estimate_grid_normals(points.astype(np.float32)).astype(float)
    found = find_spheres(points, normals, 25.0, 5)
    # 3000 points each: what is not noise / sqrt(3000) comes from a few ground points near by.
    assert np.allclose(np.stack([s.centre for s in found]), CENTRES, atol=0.05)


def test_missing_spheres_are_missed() -> None:
    points = range_image()
    normals = estimate_grid_normals(points.astype(np.float32)).astype(float)
    with pytest.raises(FailedWork, match="2 spheres"):
        find_spheres(points[:, :100], normals[:, :100], 25.0, 5)


def test_scale_and_distances() -> None:
    turned = CENTRES[:, [2, 0, 1]] * (1.0 + 200e-6) + 7.0
    found = compare_centre_distances(turned, CENTRES)
    assert found.scale_ppm == pytest.approx(200.0, abs=1e-6)
    # Distances of 60 to 124 mm, 200 ppm of them.
    assert 0.012 < found.rms_mm < 0.025


def test_distances_have_a_sign() -> None:
    sphere = Sphere(np.array([0.0, 0.0, 400.0]), 25.0)
    assert sphere.distances(np.array([[0.0, 0.0, 374.0], [0.0, 0.0, 376.0]])) == pytest.approx(
        [1.0, -1.0]
    )


PLACE = RigidTransform.from_rotation_vector([0.15, 0.1, 0.4], [-10.0, -17.0, 402.0])


def plate(bend_mm: float = 0.0, noise_mm: float = 0.0) -> np.ndarray:
    x, y = np.meshgrid(np.linspace(-80, 80, 161), np.linspace(-60, 60, 121))
    z = bend_mm * np.sqrt(7.2) * ((x / 80.0) ** 2 - 1.0 / 3.0)
    z = z + noise_mm * np.random.default_rng(0).standard_normal(z.shape)
    return PLACE.apply(np.stack([x, y, z], axis=-1).reshape(-1, 3))


def test_a_flat_plate_is_flat() -> None:
    assert measure_flatness(plate()).rms_mm < 1e-10


def test_noise_hardly_counts_as_systematic() -> None:
    noise = 0.02
    found = measure_flatness(plate(noise_mm=noise))
    assert found.rms_mm == pytest.approx(noise, rel=0.02)  # 19481 draws: half a percent
    # 28 terms, 3 of them taken by the plane: sqrt(25 / 19481) of the noise, give or take 1 / 7.
    assert found.systematic_rms_mm == pytest.approx(noise * np.sqrt(25 / 19481), rel=0.5)


def test_a_bend_under_noise_is_measured() -> None:
    # x^2 - 1/3 over [-1, 1] has an RMS of sqrt(4 / 45): sqrt(7.2) of it is 0.8 of bend_mm.
    wanted = 0.01 * np.sqrt(7.2 * 4.0 / 45.0)
    found = measure_flatness(plate(bend_mm=0.01, noise_mm=0.02))
    # The noise's share of 0.0007 mm adds in squares; the grid's ends weigh a percent more.
    assert found.systematic_rms_mm == pytest.approx(wanted, rel=0.05)


@pytest.mark.parametrize(
    "turn", [[0.0, 0.0, 0.0], [0.5, 0.3, 0.0], [-0.5, 0.3, 2.0], [3.0, 0.2, -1.0]]
)
@pytest.mark.parametrize(
    "place", [[40.0, 30.0, 500.0], [-40.0, 30.0, 500.0], [30.0, -40.0, -500.0]]
)
def test_wherever_a_plane_lies_its_normal_points_away_from_the_origin(
    turn: list[float], place: list[float]
) -> None:
    placed = RigidTransform.from_rotation_vector(turn, place)
    x, y = np.meshgrid(np.linspace(-80, 80, 9), np.linspace(-60, 60, 7))
    points = placed.apply(np.stack([x, y, 0.0 * x], axis=-1).reshape(-1, 3))
    normal, offset = fit_plane(points)
    # The plane's own normal, either way: exact but for rounding.
    assert offset == pytest.approx(abs(placed.rotation[:, 2] @ placed.translation), abs=1e-9)
    np.testing.assert_allclose(points @ normal, offset, atol=1e-9)


def test_what_is_smooth_are_terms_of_up_to_the_degree_of_both_together() -> None:
    points = plate()[::11]
    x, y = (PLACE.inverse().apply(points)[:, :2] / [80.0, 60.0]).T
    smooth = 0.3 * x**6 - 0.2 * x**2 * y**4 + 0.1 * y
    # Solved to rounding, of values up to 0.6.
    np.testing.assert_allclose(fit_polynomial(points, smooth), smooth, atol=1e-9)
    assert np.ptp(fit_polynomial(points, x**4 * y**3) - x**4 * y**3) > 0.05
    np.testing.assert_allclose(fit_polynomial(points, x * y, 2), x * y, atol=1e-9)
    assert np.ptp(fit_polynomial(points, x * y, 1)) < 0.05  # of 2
