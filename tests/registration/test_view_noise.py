"""How noisy each view is, and what is open of a board's shape beforehand."""

import numpy as np
import pytest

from bodyscan.geometry.transforms import twist_jacobian
from bodyscan.registration.normal_equations import FreeShape, view_sigmas


def test_a_view_at_a_slant_counts_by_its_own_noise() -> None:
    rng = np.random.default_rng(0)
    views = [0.016 * rng.standard_normal(96) for _ in range(9)] + [0.065 * rng.standard_normal(96)]
    sigmas = view_sigmas(views)
    # Of 96 residuals a sigma is known to 7 %; a tenth of the view's is that of all views together.
    np.testing.assert_allclose(sigmas[-1] / np.median(sigmas[:-1]), 0.065 / 0.016, rtol=0.25)
    np.testing.assert_allclose(sigmas[:-1], np.median(sigmas[:-1]), rtol=0.2)


@pytest.mark.parametrize("noise_px", [0.0, 1e-9])
def test_views_without_noise_weigh_alike(noise_px: float) -> None:
    """Advice counts what views would tell that nobody took: computed, without noise."""
    views = [noise_px * np.ones(48), np.zeros(96), np.zeros(200)]
    np.testing.assert_allclose(view_sigmas(views), 1.0)


def test_of_a_free_shape_motion_is_known_and_size_as_little_as_said() -> None:
    x, y = np.meshgrid(np.arange(8) * 40.0, np.arange(6) * 40.0)
    points = np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)
    shape = FreeShape(points, sigma_mm=1.0, size_sigma=1e-4)
    covariance = np.linalg.inv(shape.prior_information)
    arms = points - points.mean(axis=0)
    size = arms.ravel() / np.linalg.norm(arms)
    expected = 1e-4 * float(np.linalg.norm(arms))
    assert np.sqrt(size @ covariance @ size) == pytest.approx(expected, rel=1e-2)
    turn = twist_jacobian(arms).reshape(-1, 6)[:, 2]
    assert np.sqrt(turn @ covariance @ turn) / np.linalg.norm(turn) < 1e-3
    bend = np.zeros_like(arms)
    bend[:, 2] = (arms[:, 0] / 140.0) ** 2 - np.mean((arms[:, 0] / 140.0) ** 2)
    bend /= np.linalg.norm(bend)
    assert np.sqrt(bend.ravel() @ covariance @ bend.ravel()) == pytest.approx(1.0, rel=1e-3)
