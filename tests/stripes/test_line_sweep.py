"""A line of light swept over a surface: s from when it comes and goes, with the noise it has."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import erf

from bodyscan.stripes.numbered_stripes import REACH, _Sweep, decode_sweep
from bodyscan.stripes.stripe_map import StripeMap

STRIPES = 40
SHAPE = (60, 240)
S = np.linspace(2.5, 37.0, SHAPE[1]) + 0.8 * np.sin(np.arange(SHAPE[0]) / 9.0)[:, None]


def swept(
    blur: float, noise: float = 0.0, *, ramp: float = 0.0, bright: float = 160.0
) -> StripeMap:
    """A stripe at a time, its edges blurred by so many stripes."""
    edges = np.arange(STRIPES + 1)[:, None, None]
    past = 0.5 * (1.0 + erf((S - edges) / (np.sqrt(2.0) * blur)))
    light = bright * (past[:-1] - past[1:])
    rng = np.random.default_rng(0)
    sigma = np.sqrt(noise**2 + ramp * light)
    frames = np.clip(20.0 + light + sigma * rng.normal(size=light.shape), 0.0, 255.0)
    lit = np.full(SHAPE, 20.0 + bright) + noise * rng.normal(size=SHAPE)
    return decode_sweep(np.rint(lit).astype(np.uint8), np.rint(frames).astype(np.uint8), "vertical")


def off(found: StripeMap) -> np.ndarray:
    return np.asarray(found.s - S)[3:-3, 12:-12]


@pytest.mark.parametrize("blur", [0.5, 0.8])
def test_s_is_exact_whatever_the_blur(blur: float) -> None:
    found = swept(blur)
    known = np.isfinite(off(found))
    assert known.mean() > 0.98
    # Whole grey levels: of 160, a fifth of a percent; a line three stripes wide is not seen whole.
    assert np.sqrt(np.mean(off(found)[known] ** 2)) < 0.01


@pytest.mark.parametrize(("noise", "ramp"), [(1.5, 0.0), (3.5, 0.0), (0.7, 0.03)])
def test_its_sigma_is_how_far_noise_puts_it_off(noise: float, ramp: float) -> None:
    found = swept(0.6, noise, ramp=ramp)
    known = np.isfinite(off(found))
    assert known.mean() > 0.9
    sigma = found.sigma[3:-3, 12:-12][known]
    # The median of what is off over its sigma, for which outliers do not count.
    ratio = np.median(np.abs(off(found)[known]) / sigma) / 0.6745
    assert ratio == pytest.approx(1.0, abs=0.25)


def test_a_broad_line_puts_s_off_to_neither_side() -> None:
    """With light seen in seven images; as many count before the brightest as after it."""
    found = off(swept(1.2))
    assert np.isfinite(found).mean() > 0.98
    # Rounding to whole grey levels leaves 0.008 of each pixel, and of the mean nothing; without
    # the last image it is 0.027.
    assert abs(np.nanmean(found)) < 0.005


@pytest.mark.parametrize("share", [0.4, 1.0, 2.0])
def test_how_noise_rises_is_told_whatever_part_of_the_lit_image_the_line_shows(
    share: float,
) -> None:
    rng = np.random.default_rng(4)
    level = rng.uniform(30.0, 200.0, (100, 400))
    rise, base = 0.05, np.full(level.shape, 20.0, np.float32)
    window = np.zeros((2 * REACH + 1, *level.shape), np.float32)
    window[REACH] = share * level + np.sqrt(rise * share * level) * rng.normal(size=level.shape)
    lit = base + level + np.sqrt(rise * level) * rng.normal(size=level.shape)
    sweep = _Sweep(base, np.zeros(level.shape, np.int32), window, base)
    # Variances in bands of thousands of pixels: to 3 %, and the median of these.
    assert sweep.noise_rise(lit.astype(np.float32), 0.0) == pytest.approx(rise, rel=0.06)
