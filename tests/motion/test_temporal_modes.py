"""What is alike in time, and what is not known of it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import gamma, kv

from bodyscan.alignment.sway_prior import stance_correlation
from bodyscan.motion.temporal_modes import (
    BREATHS_S,
    PHASES,
    TemporalModes,
    breath_correlation,
    breath_covariances,
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
    every, likely = breath_covariances(courses, seconds.tolist(), 1.1)
    assert len(every) == len(BREATHS_S) * len(PHASES)
    length, begun = 4, 3
    turns = 2.0 * np.pi * np.append(seconds, 1.1) / BREATHS_S[length] + PHASES[begun]
    amplitudes = np.linalg.pinv(np.vstack([courses.values, courses.middle])) @ np.cos(turns)
    unlike = [amplitudes @ np.linalg.solve(one, amplitudes) for one in every]
    assert np.argmin(unlike) == length * len(PHASES) + begun
    # Its variance is that of the sine's middle and more: 1/2 of cos squared.
    assert min(unlike) == pytest.approx(0.5, rel=0.05)
    # Sixteen a minute are likeliest, ten and twenty-four are not.
    by_length = likely.reshape(len(BREATHS_S), -1)
    assert likely.sum() == pytest.approx(1.0)
    assert BREATHS_S[by_length[:, 0].argmax()] == pytest.approx(3.75, rel=0.05)
    assert by_length[[0, -1]].max() < 0.15 * by_length.max()
    # What is half a turn later is the same with the other sign, a quarter comes with the lag alone.
    quarter = (begun + len(PHASES) // 2) % len(PHASES) + length * len(PHASES)
    assert unlike[quarter] == pytest.approx(0.5 / 0.35**2, rel=0.15)
    for one in every:
        np.testing.assert_allclose(one, one.T, atol=1e-12)
        assert np.linalg.eigvalsh(one).min() > 0.0


def test_where_a_moment_is_not_known_any_breath_is() -> None:
    courses = TemporalModes.from_correlation(breath_correlation, [0.2, None, 0.6], 0.4)
    every, likely = breath_covariances(courses, [0.2, None, 0.6], 0.4)
    np.testing.assert_array_equal(every, np.eye(courses.count)[None])
    assert likely == 1.0
