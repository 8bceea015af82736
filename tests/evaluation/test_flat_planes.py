"""How flat a plate is, and how much of that is not noise."""

import numpy as np
import pytest

from bodyscan.evaluation.planes import best_plane, flatness
from bodyscan.geometry.transforms import RigidTransform

PLACE = RigidTransform.from_rotation_vector([0.15, 0.1, 0.4], [-10.0, -17.0, 402.0])


def plate(bend_mm: float = 0.0, noise_mm: float = 0.0, seed: int = 0) -> np.ndarray:
    x, y = np.meshgrid(np.linspace(-80, 80, 161), np.linspace(-60, 60, 121))
    z = bend_mm * np.sqrt(7.2) * ((x / 80.0) ** 2 - 1.0 / 3.0)
    z = z + noise_mm * np.random.default_rng(seed).standard_normal(z.shape)
    return PLACE.apply(np.stack([x, y, z], axis=-1).reshape(-1, 3))


def test_a_flat_plate_is_flat() -> None:
    found = flatness(plate())
    assert found.rms_mm < 1e-10
    assert found.normal == pytest.approx(PLACE.rotation[:, 2], abs=1e-12)
    assert found.offset_mm == pytest.approx(PLACE.rotation[:, 2] @ PLACE.translation, abs=1e-9)


def test_noise_hardly_counts_as_systematic() -> None:
    noise = 0.02
    found = flatness(plate(noise_mm=noise))
    assert found.rms_mm == pytest.approx(noise, rel=0.02)  # 19481 draws: half a percent
    # 28 terms, 3 of them taken by the plane: sqrt(25 / 19481) of the noise, give or take 1 / 7.
    assert found.systematic_rms_mm == pytest.approx(noise * np.sqrt(25 / 19481), rel=0.5)


def test_a_bend_under_noise_is_measured() -> None:
    # x^2 - 1/3 over [-1, 1] has an RMS of sqrt(4 / 45): sqrt(7.2) of it is 0.8 of bend_mm.
    wanted = 0.01 * np.sqrt(7.2 * 4.0 / 45.0)
    found = flatness(plate(bend_mm=0.01, noise_mm=0.02))
    # The noise's share of 0.0007 mm adds in squares; the grid's ends weigh a percent more.
    assert found.systematic_rms_mm == pytest.approx(wanted, rel=0.05)


def test_the_plane_faces_away_from_the_camera() -> None:
    normal, offset = best_plane(plate())
    assert offset > 0
    assert normal[2] > 0
