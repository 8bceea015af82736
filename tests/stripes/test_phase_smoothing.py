"""What smoothing takes out of phases, and what it must leave."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from bodyscan.fusion.quadratic_fit import noise_gain, window_basis
from bodyscan.stripes.phase.decoding import CORRELATION_PX, smooth_phase

V, U = np.mgrid[:80, :100].astype(np.float32)
SIGMA = np.full(U.shape, 0.1, np.float32)
LEFT = np.sqrt(45.0) / 9.0  # of the noise, by the fit's weights


def test_quadratics_and_sharp_ridges_along_lines_or_columns_stay() -> None:
    smooth = (3 + U + 0.5 * V + 0.003 * U * V - 0.002 * U**2).astype(np.float32)
    ridge = 0.2 * (U % 7 == 0) + 0.2 * (V % 9 == 0)
    for s in (smooth, (smooth + ridge).astype(np.float32)):
        np.testing.assert_allclose(smooth_phase(s, SIGMA)[0], s, atol=2e-5)


@pytest.mark.parametrize("reach", [2, 3, 5])
def test_a_fit_over_many_pixels_is_nearly_as_noisy_as_before_and_its_sigma_says_so(
    reach: int,
) -> None:
    """Found by the spread of fits to smoothed noise; a triangle of correlation is right to 6 %."""
    basis = window_basis(reach)
    weights = np.linalg.solve(basis.T @ basis, basis.T)[0].reshape(2 * reach + 1, -1)
    noise = np.random.default_rng(5).normal(0.0, 0.1, (600, 600)).astype(np.float32)
    smooth, sigma = smooth_phase(noise, np.full_like(noise, 0.1))
    fits = cv2.filter2D(smooth, -1, weights)[9:-9, 9:-9]
    claimed = (
        sigma[300, 300]
        * noise_gain(reach, (CORRELATION_PX, CORRELATION_PX))
        * np.linalg.norm(weights)
    )
    assert claimed == pytest.approx(np.std(fits), rel=0.06)


def test_what_is_beside_a_gap_or_no_noise_stays_as_it_is() -> None:
    s = U.copy()
    s[40, 50] = np.nan
    s[20, 30] += 5.0
    found, sigma = smooth_phase(s, SIGMA)
    np.testing.assert_array_equal(np.isnan(found), np.isnan(s))
    beside = np.s_[39:42, 49:52]
    np.testing.assert_array_equal(found[beside], s[beside])
    np.testing.assert_array_equal(sigma[beside], SIGMA[beside])
    assert found[20, 30] == s[20, 30]
    np.testing.assert_array_equal(found[0], s[0])
