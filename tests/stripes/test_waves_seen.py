"""Waves of light by themselves: their turn at each pixel, its sigma, and whether several tell s."""

from __future__ import annotations

import numpy as np
import pytest

from bodyscan.stripes.codes.phase_shift import find_repetition
from bodyscan.stripes.phase.waves import (
    estimate_white_and_black,
    estimate_white_image,
    measure_wave,
    split_waves,
)
from bodyscan.stripes.stripe_code import Wave

S = np.linspace(0.0, 47.0, 60).reshape(3, 20)


def shown(wave: Wave, bright: float = 80.0, dark: float = 15.0) -> np.ndarray:
    """Images as `Wave` describes them."""
    k = np.arange(wave.steps)[:, None, None]
    angle = 2.0 * np.pi * ((S - wave.origin) / wave.period - wave.sign * k / wave.steps)
    return np.asarray(dark + bright * (0.5 + 0.5 * np.cos(angle + wave.start)), np.float32)


@pytest.mark.parametrize(
    "wave",
    [
        Wave(12.0, 3),
        Wave(12.0, 5, "backward"),
        Wave(7.5, 4, "forward", 0.8),
        Wave(7.5, 4, "backward", -2.3, 3.0),
        Wave(60.0, 8, "forward", 0.0, 11.0),
    ],
)
def test_a_waves_turn_is_s_over_its_period_whatever_its_start(wave: Wave) -> None:
    seen = measure_wave(shown(wave), wave)
    off = seen.turn - S / wave.period
    np.testing.assert_allclose(off - np.rint(off), 0.0, atol=1e-5)
    assert seen.turn.min() >= 0.0
    assert seen.turn.max() <= 1.0
    np.testing.assert_allclose(seen.amplitude, 40.0, rtol=1e-5)
    np.testing.assert_allclose(seen.mean, 55.0, rtol=1e-5)


@pytest.mark.parametrize(("wave", "noise"), [(Wave(12.0, 3), 2.0), (Wave(12.0, 8), 2.0)])
def test_sigma_of_a_turn_matches_its_noise(wave: Wave, noise: float) -> None:
    clean, rng = shown(wave), np.random.default_rng(0)
    off = []
    for _ in range(60):
        noisy = (clean + noise * rng.normal(size=clean.shape)).astype(np.float32)
        turned = measure_wave(noisy, wave).turn - S / wave.period
        off.append(turned - np.rint(turned))
    sigma = measure_wave(clean, wave).sigma(np.full(S.shape, noise, np.float32))
    # 3,600 of them: their deviation is known to 1.2 %.
    assert np.std(off) == pytest.approx(float(sigma.mean()), rel=0.05)
    # Without noise what no wave is better than: half a thousandth of a turn.
    np.testing.assert_allclose(measure_wave(clean, wave).sigma(np.zeros(S.shape, np.float32)), 5e-4)


def test_white_and_black_are_mean_plus_and_minus_amplitude() -> None:
    waves = (Wave(12.0, 3), Wave(40.0, 5))
    images = np.concatenate([shown(wave) for wave in waves])
    parts = split_waves(images, waves)
    assert [len(part) for part in parts] == [3, 5]
    assert np.array_equal(np.concatenate(parts), images)
    white, black = estimate_white_and_black(
        [measure_wave(part, wave) for part, wave in zip(parts, waves, strict=True)]
    )
    np.testing.assert_allclose(white, 95.0, rtol=1e-5)
    np.testing.assert_allclose(black, 15.0, rtol=1e-4)
    np.testing.assert_allclose(estimate_white_image(images, waves), 95.0, rtol=1e-5)
    in_levels = estimate_white_image(np.rint(images).astype(np.uint8), waves)
    assert in_levels.dtype == np.uint8
    np.testing.assert_allclose(in_levels.astype(int), 95, atol=1)
    # Grey levels are 0 to 255, whatever a noisy wave says.
    glaring = measure_wave(shown(waves[0], bright=270.0, dark=-10.0), waves[0])
    white, black = estimate_white_and_black([glaring])
    assert set(white.ravel().tolist()) == {255.0}
    assert set(black.ravel().tolist()) == {0.0}


@pytest.mark.parametrize(
    ("periods", "stripes", "again"),
    [
        ((20.0, 240.0), 240, None),
        ((20.0, 240.0), 241, 240.0),
        ((20.0,), 20, None),
        ((20.0,), 21, 20.0),
        ((12.0, 18.0), 100, 36.0),
        ((12.0, 18.0), 36, None),
        ((18.0, 12.0), 37, 36.0),
        # 17 / 17.17 is a hundredth of a period less than one.
        ((17.0, 17.17), 1000, 17.0),
    ],
)
def test_waves_repeat_after_their_common_multiple(
    periods: tuple[float, ...], stripes: int, again: float | None
) -> None:
    assert find_repetition(periods, stripes, 0.05) == again
