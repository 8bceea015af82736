"""How flat a plate is, and how much of that is not noise."""

import numpy as np
import pytest

from bodyscan.evaluation.primitives import fit_plane, fit_polynomial, measure_flatness
from bodyscan.geometry.transforms import RigidTransform

PLACE = RigidTransform.from_rotation_vector([0.15, 0.1, 0.4], [-10.0, -17.0, 402.0])


def plate(bend_mm: float = 0.0, noise_mm: float = 0.0, seed: int = 0) -> np.ndarray:
    x, y = np.meshgrid(np.linspace(-80, 80, 161), np.linspace(-60, 60, 121))
    z = bend_mm * np.sqrt(7.2) * ((x / 80.0) ** 2 - 1.0 / 3.0)
    z = z + noise_mm * np.random.default_rng(seed).standard_normal(z.shape)
    return PLACE.apply(np.stack([x, y, z], axis=-1).reshape(-1, 3))


def test_a_flat_plate_is_flat() -> None:
    assert measure_flatness(plate()).rms_mm < 1e-10
    normal, offset = fit_plane(plate())
    assert normal == pytest.approx(PLACE.rotation[:, 2], abs=1e-12)
    assert offset == pytest.approx(PLACE.rotation[:, 2] @ PLACE.translation, abs=1e-9)


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


def test_the_plane_faces_away_from_the_camera() -> None:
    normal, offset = fit_plane(plate())
    assert offset > 0
    assert normal[2] > 0


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
