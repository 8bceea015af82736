"""What is alike in time, and what is not known of it."""

from __future__ import annotations

import numpy as np
import pytest

from bodyscan.alignment.moments import Courses, of_breath, of_stance


@pytest.mark.parametrize("correlation", [of_stance, of_breath])
def test_courses_sum_to_what_is_alike(correlation: object) -> None:
    alike = of_stance if correlation is of_stance else of_breath
    seconds = np.linspace(0.1, 2.1, 12)
    courses = Courses.of(alike, seconds.tolist())
    every = np.vstack([courses.values, courses.middle])
    at = np.append(seconds, 1.1)
    # Less than a thousandth of the first course is left out, of each of the others.
    np.testing.assert_allclose(every @ every.T, alike(at[:, None] - at), atol=0.01)


def test_speeds_are_those_of_the_courses() -> None:
    seconds = [0.2, 0.5, 0.50001, 1.4]
    courses = Courses.of(of_stance, seconds)
    np.testing.assert_allclose(
        (courses.values[2] - courses.values[1]) / 1e-5, courses.speeds[1], rtol=2e-3, atol=2e-3
    )


def test_a_breath_comes_back_and_a_stance_does_not() -> None:
    assert of_breath(np.array([1.9]))[0] < -0.5
    assert of_stance(np.array([1.9]))[0] > 0.0
    assert of_stance(np.array([0.01]))[0] > 0.999


def test_a_moment_that_is_not_known_is_like_no_other() -> None:
    courses = Courses.of(of_stance, [0.2, None, 0.6])
    assert np.all(courses.values[1] @ courses.values[[0, 2]].T == 0.0)
    free = Courses.of(of_stance, [None, None])
    np.testing.assert_array_equal(free.values, np.eye(2))
    np.testing.assert_array_equal(free.middle, np.zeros(2))
