"""The error that a bent response makes of a wave's phase: found from the wave, and taken out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bodyscan.stripes.phase.projector_response import (
    PhaseError,
    correct_wave,
    estimate_error,
    estimate_error_against,
)
from bodyscan.stripes.phase.waves import MeasuredWave
from bodyscan.stripes.stripe_code import Wave

STRIPES = 120
LINES, WIDTH = 60, 300
S = np.linspace(3.0, 117.0, WIDTH) + np.linspace(0.0, 2.0, LINES)[:, None]


def seen(
    wave: Wave, error: PhaseError | None, noise: float = 0.0, s: np.ndarray = S
) -> MeasuredWave:
    """Of a flat surface; error: of the turn as it is read."""
    true = s / wave.period
    turn = true.copy()
    if error is not None:
        for _ in range(20):  # what is read, less its error, is the truth
            turn = true + error.evaluate(turn.astype(np.float32) % np.float32(1.0))
    turn = turn + noise * np.random.default_rng(0).normal(size=S.shape)
    grey = np.full(S.shape, 50.0, np.float32)
    return MeasuredWave(wave, (turn % 1.0).astype(np.float32), grey, grey)


def left(wave: MeasuredWave, s: np.ndarray = S) -> float:
    """RMS of the turns, turns."""
    off = wave.turn - s / wave.wave.period
    return float(np.sqrt(np.mean((off - np.rint(off)) ** 2)))


ERROR = PhaseError(3, np.array([0.012, -0.004, 0.0, 0.0]), np.array([-0.02, 0.003, 0.001, 0.0]))
EVERYWHERE = np.ones(S.shape, bool)


def test_the_error_is_found_despite_surface_edges() -> None:
    s = S.copy()
    s[20:, 120:] += 7.4  # another surface, and its rim
    wave = seen(Wave(20.0, 3), ERROR, 0.001, s)
    usable = EVERYWHERE.copy()
    usable[30:40, 60:200:7] = False
    error = estimate_error(wave, usable, STRIPES)
    assert error is not None
    assert left(correct_wave(wave, error), s) < 1.5e-3


def test_noise_few_pixels_or_few_periods_give_no_error() -> None:
    clean = seen(Wave(20.0, 3), None, 0.003)
    assert estimate_error(clean, EVERYWHERE, STRIPES) is None
    bent = seen(Wave(20.0, 3), ERROR, 0.002)
    few = EVERYWHERE.copy()
    few[8:] = False
    assert estimate_error(bent, few, STRIPES) is None
    # Four periods within the stripes, or hardly less.
    assert estimate_error(seen(Wave(30.0, 3), ERROR, 0.002), EVERYWHERE, STRIPES) is not None
    assert estimate_error(seen(Wave(30.1, 3), ERROR, 0.002), EVERYWHERE, STRIPES) is None


def test_the_error_of_a_long_wave_is_found_against_a_finer_one() -> None:
    fine, long = seen(Wave(12.0, 8), None, 0.002), seen(Wave(120.0, 3), ERROR, 0.001)
    error = estimate_error_against(long, fine, EVERYWHERE, STRIPES)
    assert error is not None
    assert left(long) > 0.015
    assert left(correct_wave(long, error)) < 1.3e-3
    # Over less than its own period it may be a whole turn of the finer one.
    assert estimate_error_against(long, fine, np.abs(S - 45.0) < 15.0, STRIPES) is None
    # One that repeats within the stripes is not asked.
    assert estimate_error_against(seen(Wave(119.0, 3), ERROR), fine, EVERYWHERE, STRIPES) is None
    # Without an error the two agree.
    none = estimate_error_against(seen(Wave(120.0, 3), None, 0.001), fine, EVERYWHERE, STRIPES)
    assert none is None or np.abs([none.cosines, none.sines]).max() < 3e-4


def test_a_wave_that_has_nothing_to_do_with_the_finer_one_gives_no_error() -> None:
    fine, long = seen(Wave(12.0, 8), None, 0.002), seen(Wave(120.0, 3), ERROR, 0.001)
    mixed = replace(fine, turn=np.random.default_rng(0).random(S.shape).astype(np.float32))
    assert estimate_error_against(long, mixed, EVERYWHERE, STRIPES) is None
    backwards = replace(long, turn=np.float32(1.0) - long.turn)
    assert estimate_error_against(backwards, fine, EVERYWHERE, STRIPES) is None
