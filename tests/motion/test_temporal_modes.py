"""What is alike in time, and what is not known of it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import gamma, kv

from bodyscan.alignment.sway_prior import stance_correlation
from bodyscan.motion.temporal_modes import (
    BREATHS_S,
    PHASES,
    SHARPNESSES,
    Breaths,
    TemporalModes,
    breath_correlation,
)


@pytest.mark.parametrize("correlation", [stance_correlation, breath_correlation])
def test_courses_sum_to_what_is_alike(correlation: object) -> None:
    alike = stance_correlation if correlation is stance_correlation else breath_correlation
    seconds = np.linspace(0.1, 2.1, 12)
    courses = TemporalModes.from_correlation(
        alike, seconds.tolist(), 0.5 * (seconds[0] + seconds[-1])
    )
    every = np.vstack([courses.values, courses.middle])
    at = np.append(seconds, 1.1)
    # Less than a thousandth of the first course is left out, of each of the others.
    np.testing.assert_allclose(every @ every.T, alike(at[:, None] - at), atol=0.01)


def test_a_breath_comes_back_and_a_stance_does_not() -> None:
    assert breath_correlation(np.array([1.9]))[0] < -0.5
    assert stance_correlation(np.array([1.9]))[0] > 0.0
    assert stance_correlation(np.array([0.01]))[0] > 0.999


def test_a_stance_is_materns_of_order_three_halves() -> None:
    """By the Bessel function of the second kind (Rasmussen and Williams 2006, 4.14)."""
    seconds = np.geomspace(0.01, 30.0, 40)
    scaled = np.sqrt(3.0) * seconds / 0.8
    bessel = 2.0**-0.5 / gamma(1.5) * scaled**1.5 * kv(1.5, scaled)
    np.testing.assert_allclose(stance_correlation(-seconds), bessel, rtol=1e-9)


def test_a_moment_that_is_not_known_is_like_no_other() -> None:
    courses = TemporalModes.from_correlation(stance_correlation, [0.2, None, 0.6], 0.4)
    assert np.all(courses.values[1] @ courses.values[[0, 2]].T == 0.0)
    free = TemporalModes.from_correlation(stance_correlation, [None, None], 0.0)
    np.testing.assert_array_equal(free.values, np.eye(2))
    np.testing.assert_array_equal(free.middle, np.zeros(2))


def test_each_breath_has_its_own_length_and_phase() -> None:
    """A tide of one of the lengths, at the moments and half way, is what one of them expects."""
    seconds = np.linspace(0.1, 2.1, 12)
    courses = TemporalModes.from_correlation(breath_correlation, seconds.tolist(), 1.1)
    breaths = Breaths.from_modes(courses, seconds.tolist(), 1.1)
    waves = breaths.waves.reshape(len(SHARPNESSES), len(BREATHS_S), len(PHASES), courses.count, 2)
    length, begun, every = 4, 3, np.vstack([courses.values, courses.middle])
    turn = 2.0 * np.pi * np.append(seconds, 1.1) / BREATHS_S[length] + PHASES[begun]
    share = np.mod(turn / (2.0 * np.pi), 1.0)
    # Breathed in at 0, out at 0.6 of it: cos^4 has a mean of 3/8 and a variance of 35/128 - 9/64.
    half = np.where(share < 0.6, share / 0.6, 1.0 + (share - 0.6) / 0.4)
    tide = (np.cos(0.5 * np.pi * half) ** 4 - 0.375) / np.sqrt(35.0 / 128.0 - 9.0 / 64.0)
    np.testing.assert_allclose(every @ waves[1, length, begun, :, 0], tide, atol=0.05)
    # Sixteen a minute are likeliest, ten and twenty-four are not.
    by_length = breaths.priors.reshape(waves.shape[:3]).sum(axis=(0, 2))
    assert by_length.sum() == pytest.approx(1.0)
    assert BREATHS_S[by_length.argmax()] == pytest.approx(3.75, rel=0.07)
    assert by_length[[0, -1]].max() < 0.15 * by_length.max()
    assert np.linalg.eigvalsh(breaths.irregular).min() > 0.0


def test_where_a_moment_is_not_known_any_breath_is() -> None:
    courses = TemporalModes.from_correlation(breath_correlation, [0.2, None, 0.6], 0.4)
    breaths = Breaths.from_modes(courses, [0.2, None, 0.6], 0.4)
    assert not breaths.waves.any()
    np.testing.assert_array_equal(breaths.irregular, np.eye(courses.count))
    assert breaths.priors == 1.0
