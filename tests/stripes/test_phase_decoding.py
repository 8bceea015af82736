"""Which period of the finest wave a pixel shows, how sure that is, and what smoothing takes out."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from bodyscan.fusion.quadratic_fit import compute_noise_gain, make_window_basis
from bodyscan.stripes.phase.decoding import (
    CORRELATION_PX,
    PhaseOrder,
    find_phase_order,
    smooth_phase,
)
from bodyscan.stripes.phase.waves import MeasuredWave
from bodyscan.stripes.stripe_code import Wave

STRIPES = 240
SHAPE = (60, 200)
RNG = np.random.default_rng(0)
S = np.linspace(5.0, 235.0, SHAPE[1]) + RNG.uniform(-3.0, 3.0, SHAPE)


def order_of(
    periods: tuple[float, ...],
    sigma: float = 0.005,
    *,
    apart: tuple[float, ...] | None = None,
    usable: np.ndarray | None = None,
    s: np.ndarray = S,
) -> PhaseOrder:
    """Of waves whose turns err by `sigma` and say so; apart: turns that each is off besides."""
    rng = np.random.default_rng(1)
    waves, sigmas = [], []
    for period, off in zip(periods, apart or (0.0,) * len(periods), strict=True):
        turn = (s / period + off + sigma * rng.normal(size=s.shape)) % 1.0
        grey = np.full(s.shape, 50.0, np.float32)
        waves.append(MeasuredWave(Wave(period, 4), turn.astype(np.float32), grey, grey))
        sigmas.append(np.full(s.shape, sigma, np.float32))
    every = np.ones(s.shape, bool) if usable is None else usable
    return find_phase_order(waves, sigmas, every, STRIPES)


@pytest.mark.parametrize("periods", [(20.0, 240.0), (12.0, 60.0, 240.0), (18.0, 20.0, 23.0)])
def test_s_is_the_weighted_mean_of_all_waves(periods: tuple[float, ...]) -> None:
    found = order_of(periods)
    assert found.certain.mean() > 0.99
    off = (found.s - S)[found.certain]
    # Waves of about the finest's period share the noise, longer ones only tell its order.
    akin = np.array([period for period in periods if period <= 2.0 * periods[0]])
    sigma = 0.005 / np.sqrt(np.sum(akin**-2.0))
    np.testing.assert_allclose(found.sigma[found.certain], sigma, rtol=1e-4)
    assert np.std(off) == pytest.approx(sigma, rel=0.05)
    assert np.abs(off).max() < 1.0  # never a whole period
    assert found.agreed > 0.99
    np.testing.assert_allclose(found.offsets, 0.0, atol=2e-3)


def test_a_common_offset_is_reported_in_turns_of_the_finest() -> None:
    found = order_of((18.0, 20.0, 23.0), apart=(0.0, 0.02, -0.03))
    np.testing.assert_allclose(found.offsets, [0.02 * 20.0 / 18.0, -0.03 * 23.0 / 18.0], atol=3e-3)
    assert np.mean(np.abs(found.s - S)[found.certain] < 2.0) > 0.99


def test_an_order_within_noise_is_uncertain() -> None:
    # One turn of the finest is a twelfth of the long wave's: 0.0833. Between two orders chi squared
    # differs by 2 ln 10^4 = 18.4 where that is 4.3 sigmas and more.
    clear, doubtful = order_of((20.0, 240.0), sigma=0.01), order_of((20.0, 240.0), sigma=0.03)
    assert clear.certain.mean() > 0.9
    assert doubtful.certain.mean() < 0.05
    wrong = clear.certain & (np.abs(clear.s - S) > 5.0)
    assert wrong.mean() < 1e-3
    # Of pixels that noise lets tell (EASY), there are none: all are judged.
    assert doubtful.agreed < 0.05


def test_mixed_pixels_agree_with_no_order() -> None:
    rng = np.random.default_rng(3)
    mixed = np.zeros(SHAPE, bool)
    mixed[:, ::5] = True
    periods = (18.0, 20.0, 23.0)
    waves, sigmas = [], []
    for period in periods:
        turn = S / period + 0.004 * rng.normal(size=SHAPE)
        turn[mixed] = rng.random(mixed.sum())
        grey = np.full(SHAPE, 50.0, np.float32)
        waves.append(MeasuredWave(Wave(period, 4), (turn % 1.0).astype(np.float32), grey, grey))
        sigmas.append(np.full(SHAPE, 0.004, np.float32))
    found = find_phase_order(waves, sigmas, np.ones(SHAPE, bool), STRIPES)
    assert found.certain[~mixed].mean() > 0.98
    # 13 orders, of which one may agree with two waves by chance: within 4.5 sigmas of either.
    assert found.certain[mixed].mean() < 0.05
    assert found.agreed == pytest.approx(0.8, abs=0.03)


def test_s_near_either_end_is_uncertain() -> None:
    s = np.full(SHAPE, 100.0)
    sigma = 20.0 * 0.005
    s[:, 0], s[:, 1], s[:, 2], s[:, 3] = (
        2.0 * sigma,
        9.0 * sigma,
        240 - 9.0 * sigma,
        240 - 2.0 * sigma,
    )
    found = order_of((20.0, 240.0), s=s)
    assert found.certain[:, :4].mean(axis=0).tolist() == [
        pytest.approx(0.0, abs=0.1), 1.0, 1.0, pytest.approx(0.0, abs=0.1),
    ]  # fmt: skip


def test_a_single_wave_gives_s_within_its_period() -> None:
    found = order_of((240.0,))
    assert found.certain.mean() > 0.9
    assert np.std((found.s - S)[found.certain]) == pytest.approx(240.0 * 0.005, rel=0.05)
    assert found.offsets == ()
    assert order_of((240.0,), usable=np.zeros(SHAPE, bool)).agreed == 0.0


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
    basis = make_window_basis(reach)
    weights = np.linalg.solve(basis.T @ basis, basis.T)[0].reshape(2 * reach + 1, -1)
    noise = np.random.default_rng(5).normal(0.0, 0.1, (600, 600)).astype(np.float32)
    smooth, sigma = smooth_phase(noise, np.full_like(noise, 0.1))
    fits = cv2.filter2D(smooth, -1, weights)[9:-9, 9:-9]
    claimed = (
        sigma[300, 300]
        * compute_noise_gain(reach, (CORRELATION_PX, CORRELATION_PX))
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
