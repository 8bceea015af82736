"""Which breath explains what was seen of a trunk: its length, when it began, how deep it is."""

from __future__ import annotations

import numpy as np
import pytest

from bodyscan.arrays import Array, Indices
from bodyscan.motion.breath import SIZES_MM, estimate_breath_covariance
from bodyscan.motion.temporal_modes import (
    BREATHS_S,
    PHASES,
    TemporalModes,
    breath_correlation,
    breath_covariances,
)

SECONDS = np.linspace(0.1, 2.9, 16)
MIDDLE_S = 1.5
FIELDS = 20
NOISE_MM = 0.05
COURSES = TemporalModes.from_correlation(breath_correlation, SECONDS.tolist(), MIDDLE_S)
EVERY, LIKELY = breath_covariances(COURSES, SECONDS.tolist(), MIDDLE_S)


def seen(period_s: float, deep_mm: float, moments: Indices) -> tuple[Array, Array, Array]:
    """Normal equations of FIELDS places, each seen at some moments, and how high the first is in the
    middle of the scan, in courses: (n, n), (n,), (J,)."""
    rng = np.random.default_rng(3)
    high = deep_mm * np.sqrt(2.0) * rng.standard_normal(FIELDS)
    wave = np.cos(2.0 * np.pi * np.append(SECONDS, 1.5) / period_s + 0.4)
    rows = COURSES.values[moments]
    measured = high[:, None] * wave[moments] + NOISE_MM * rng.standard_normal(
        (FIELDS, len(moments))
    )
    information = np.asarray(np.kron(np.eye(FIELDS), rows.T @ rows) / NOISE_MM**2, np.float64)
    return information, (measured @ rows).ravel() / NOISE_MM**2, high * wave[-1]


def test_a_breath_is_told_that_began_before_and_ended_after_the_scan() -> None:
    """Seen for half a second at the beginning and at the end, it is known in the middle."""
    moments = np.array([0, 1, 2, 3, 12, 13, 14, 15])
    for period_s in (3.0, 4.5):
        information, pull, truth = seen(period_s, 1.4, moments)
        alike = estimate_breath_covariance(information, pull, EVERY, LIKELY)
        prior = np.kron(np.eye(FIELDS), np.linalg.inv(alike))
        found = np.linalg.solve(information + prior, pull).reshape(FIELDS, -1) @ COURSES.middle
        assert np.sqrt(np.mean((found - truth) ** 2)) < 0.1 * np.sqrt(np.mean(truth**2))


@pytest.mark.parametrize("deep_mm", [0.7, 1.4, 2.8])
def test_a_breath_is_as_deep_as_it_shows(deep_mm: float) -> None:
    information, pull, _ = seen(3.6, deep_mm, np.arange(16))
    alike = estimate_breath_covariance(information, pull, EVERY, LIKELY)
    # Sizes are tried in steps of 1.4; 20 places tell it to a sixth.
    mean = COURSES.values @ alike @ COURSES.values.T
    assert np.sqrt(np.mean(np.diag(mean))) == pytest.approx(deep_mm, rel=0.4)


def test_who_does_not_breathe_is_left_alone() -> None:
    information, pull, _ = seen(3.6, 0.0, np.arange(16))
    alike = estimate_breath_covariance(information, pull, EVERY, LIKELY)
    assert np.trace(alike) < 1.01 * SIZES_MM[0] ** 2 * np.trace(EVERY.mean(axis=0)) * 2.0


def test_of_nothing_seen_every_breath_is_as_likely() -> None:
    nothing = np.zeros((COURSES.count, COURSES.count))
    alike = estimate_breath_covariance(nothing, np.zeros(COURSES.count), EVERY, LIKELY)
    np.testing.assert_allclose(
        alike, np.mean(SIZES_MM**2) * np.einsum("kij,k->ij", EVERY, LIKELY), atol=1e-12
    )
    assert len(EVERY) == len(BREATHS_S) * len(PHASES)
