"""Noise of grey levels, measured from frames and waves that should show the same."""

from __future__ import annotations

import numpy as np
import pytest

from bodyscan.stripes.grey_noise import fit_variance, measure_noise
from bodyscan.stripes.phase.waves import measure_wave, measure_wave_noise
from bodyscan.stripes.scan_lines import ScanLines
from bodyscan.stripes.stripe_code import Wave

U8 = np.dtype(np.uint8)
F32 = np.dtype(np.float32)


def line(of: np.dtype, grey: list[float], variance: list[float], count: list[float]) -> np.ndarray:
    return fit_variance(np.array(grey), np.array(variance), np.array(count), of)


def test_variance_that_rises_with_the_grey_level_is_linear() -> None:
    found = line(U8, [8.0, 100.0, 200.0], [2.16, 4.0, 6.0], [600, 600, 600])
    np.testing.assert_allclose(found, 2.0 + 0.02 * np.arange(256), rtol=1e-5)


def test_variance_is_at_least_that_of_rounding() -> None:
    np.testing.assert_allclose(line(U8, [8.0, 100.0], [0.0, 0.01], [600, 600]), 0.15)
    np.testing.assert_allclose(line(F32, [8.0, 100.0], [0.0, 0.0], [600, 600]), 0.15 / 256)
    # Where a rising line would be below it.
    found = line(U8, [50.0, 150.0, 250.0], [0.2, 10.0, 20.0], [600, 600, 600])
    assert found[0] == np.float32(0.15)
    # Nothing known: one grey level.
    np.testing.assert_allclose(line(U8, [], [], []), 1.0)


def frames(sigma: float, *, inverses: bool, ramp: float = 0.0) -> ScanLines:
    """Half of a picture under the coarsest pattern; lit from 60 to 220, dark 20, noise in each frame
    with a variance that rises by `ramp` for each grey level."""
    rng = np.random.default_rng(0)
    lit = np.tile(np.linspace(60.0, 220.0, 320), (160, 1))
    dark = np.full_like(lit, 20.0)
    on = np.arange(320) % 40 < 20
    shown = np.stack([lit, dark, np.where(on, lit, dark), np.where(on, dark, lit)])
    shown += np.sqrt(sigma**2 + ramp * shown) * rng.normal(size=shown.shape)
    lit, dark, pattern, inverse = shown.astype(np.float32)
    return ScanLines(lit, dark, pattern[None], inverse[None] if inverses else None, False)


@pytest.mark.parametrize("inverses", [True, False])
@pytest.mark.parametrize("sigma", [0.5, 2.0])
def test_noise_is_measured_from_frames_that_show_the_same(sigma: float, inverses: bool) -> None:
    found = measure_noise(frames(sigma, inverses=inverses))
    # Of 12,800 pixels or more, seen twice; the brighter of two noisy ones is brighter by nothing here.
    np.testing.assert_allclose(found[20:220], sigma**2, rtol=0.1)


def test_noise_of_light_itself_rises_with_it() -> None:
    found = measure_noise(frames(1.0, inverses=True, ramp=0.02))
    np.testing.assert_allclose(found[20:220], 1.0 + 0.02 * np.arange(20, 220), rtol=0.1)


def test_motion_and_saturation_are_not_noise() -> None:
    clean = frames(1.0, inverses=True)
    pattern = clean.patterns.copy()
    pattern[0, :30] += 24.0 + 8.0  # something passed: more than noise ever makes
    lit = clean.lit.copy()
    assert clean.inverses is not None
    inverse = clean.inverses.copy()
    lit[:, 300:], pattern[0, :, 300:] = 255.0, 240.0  # burnt out, and not quite
    found = measure_noise(ScanLines(lit, clean.dark, pattern, inverse, False))
    np.testing.assert_allclose(found[20:220], 1.0, rtol=0.15)


def test_merged_exposures_are_far_less_noisy_in_the_dark() -> None:
    # Hair under the longer exposure, 0.15 levels of noise; skin under the shorter, 3 % of the light.
    rng = np.random.default_rng(0)
    hair, skin = np.linspace(2.0, 12.0, 320), np.linspace(60.0, 220.0, 320)
    lit = np.tile(np.concatenate([hair, skin]), (320, 1))
    dark = np.ones_like(lit)
    on = np.arange(640) % 160 < 80
    pattern = np.where(on, lit, dark)
    for edge in range(0, 640, 80):
        pattern[:, edge] = (lit + dark)[:, edge] / 2.0
    shown = np.stack([lit, dark, pattern, lit + dark - pattern])
    shown += np.where(shown < 40.0, 0.15, 0.03 * shown) * rng.normal(size=shown.shape)
    lit, dark, pattern, inverse = shown.astype(np.float32)
    found = measure_noise(ScanLines(lit, dark, pattern[None], inverse[None], False))
    # 2,500 pixels or more in each of five bands, and edges of 1 % within four sigmas of none.
    np.testing.assert_allclose(found[1:11], 0.15**2, rtol=0.12)
    # Chords of half an octave of a square are 3 % too high, and bands hold 1,600 pixels (4 %).
    level = np.arange(80, 200)
    np.testing.assert_allclose(found[80:200], (0.03 * level) ** 2, rtol=0.15)


def waves(sigma: float, several: tuple[Wave, ...], *, gamma: float = 1.0) -> np.ndarray:
    """(256,) as measured on 200 x 300 pixels of which s is known."""
    rng = np.random.default_rng(0)
    s = np.tile(np.linspace(0.0, 90.0, 300), (200, 1)) + np.linspace(0.0, 7.0, 200)[:, None]
    bright = np.tile(np.linspace(40.0, 90.0, 200)[:, None], (1, 300))
    seen, images = [], []
    for wave in several:
        turn = s / wave.period - np.arange(wave.steps)[:, None, None] / wave.steps
        light = (0.5 + 0.5 * np.cos(2.0 * np.pi * turn)) ** gamma
        stack = (20.0 + 2.0 * bright * light + sigma * rng.normal(size=turn.shape)).astype(
            np.float32
        )
        stack[:, :3] += 30.0 * rng.normal(size=(wave.steps, 3, 300)).astype(np.float32)  # moved
        seen.append(measure_wave(stack, wave))
        images.append(stack)
    return measure_wave_noise(seen, images, np.ones(s.shape, bool))


@pytest.mark.parametrize(
    "several",
    [
        (Wave(10.0, 3), Wave(100.0, 3)),
        (Wave(10.0, 3), Wave(30.0, 5)),
        (Wave(10.0, 4),),
        (Wave(12.0, 8),),
    ],
)
def test_noise_is_measured_from_redundant_waves(several: tuple[Wave, ...]) -> None:
    # 60,000 pixels; what moved, one in seventy, is left out but for its middle.
    np.testing.assert_allclose(waves(1.5, several)[60:180], 1.5**2, rtol=0.08)


def test_a_non_linear_response_is_not_noise() -> None:
    # Of a gamma of 2 the second harmonic is a quarter of the wave, 15 levels: 400 times the noise.
    # What harmonics do to the wave itself leaves a sixth too much.
    np.testing.assert_allclose(waves(0.5, (Wave(12.0, 6),), gamma=2.0)[60:180], 0.25, rtol=0.25)


def test_one_wave_of_three_steps_has_no_redundancy() -> None:
    np.testing.assert_allclose(waves(1.5, (Wave(10.0, 3),)), 1.0)
