"""What is alike in time, what is not known of it, and which breath explains what a trunk showed."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.special import gamma, kv

from bodyscan.alignment.sway_prior import correlate_stance
from bodyscan.arrays import Array, Indices
from bodyscan.geometry.linear_gaussian import LinearGaussianSystem
from bodyscan.motion.breath import SIZES_MM, estimate_breath
from bodyscan.motion.estimation import _find_offset_to_mean_breath
from bodyscan.motion.temporal_modes import (
    BREATHS_S,
    IRREGULAR,
    PHASES,
    SHARPNESSES,
    Breaths,
    TemporalModes,
    correlate_breath,
)


@pytest.mark.parametrize("correlate", [correlate_stance, correlate_breath])
def test_modes_sum_to_the_correlation(correlate: Any) -> None:
    seconds = np.linspace(0.1, 2.1, 12)
    modes = TemporalModes.from_correlation(correlate, seconds.tolist(), 1.1)
    every, at = np.vstack([modes.values, modes.middle]), np.append(seconds, 1.1)
    # Less than a thousandth of the first mode is left out, of each of the others.
    np.testing.assert_allclose(every @ every.T, correlate(at[:, None] - at), atol=0.01)


def test_a_stance_is_materns_of_order_three_halves() -> None:
    """By the Bessel function of the second kind (Rasmussen and Williams 2006, 4.14)."""
    seconds = np.geomspace(0.01, 30.0, 40)
    scaled = np.sqrt(3.0) * seconds / 0.8
    bessel = 2.0**-0.5 / gamma(1.5) * scaled**1.5 * kv(1.5, scaled)
    np.testing.assert_allclose(correlate_stance(-seconds), bessel, rtol=1e-9)


def test_a_moment_that_is_not_known_is_like_no_other() -> None:
    courses = TemporalModes.from_correlation(correlate_stance, [0.2, None, 0.6], 0.4)
    assert np.all(courses.values[1] @ courses.values[[0, 2]].T == 0.0)
    breaths = Breaths.from_modes(courses, [0.2, None, 0.6], 0.4)
    assert not breaths.waves.any(), "any breath is as likely"
    np.testing.assert_array_equal(breaths.irregular, np.eye(courses.count))
    free = TemporalModes.from_correlation(correlate_stance, [None, None], 0.0)
    np.testing.assert_array_equal(free.values, np.eye(2))
    np.testing.assert_array_equal(free.middle, np.zeros(2))


def test_each_breath_has_its_own_length_and_phase() -> None:
    """A tide of one of the lengths, at the moments and half way, is what one of them expects."""
    seconds = np.linspace(0.1, 2.1, 12)
    courses = TemporalModes.from_correlation(correlate_breath, seconds.tolist(), 1.1)
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
    assert correlate_breath(np.array([1.9]))[0] < -0.5, "it comes back"


SECONDS = np.linspace(0.1, 2.9, 16)
MIDDLE_S = 1.5
FIELDS = 3
NOISE_MM = 0.05
COURSES = TemporalModes.from_correlation(correlate_breath, SECONDS.tolist(), MIDDLE_S)
BREATHS = Breaths.from_modes(COURSES, SECONDS.tolist(), MIDDLE_S)


def seen(period_s: float, deep_mm: float, moments: Indices) -> tuple[LinearGaussianSystem, Array]:
    """Normal equations of FIELDS places, each seen at some moments, and how high each is in the middle
    of the scan."""
    rng = np.random.default_rng(3)
    high = deep_mm * np.sqrt(2.0) * np.array([-1.0, 0.7, -0.7])  # fields carry the surface back
    wave = np.cos(2.0 * np.pi * np.append(SECONDS, 1.5) / period_s + 0.4)
    rows = COURSES.values[moments]
    measured = high[:, None] * wave[moments] + NOISE_MM * rng.standard_normal(
        (FIELDS, len(moments))
    )
    information = np.kron(np.eye(FIELDS), rows.T @ rows) / NOISE_MM**2
    pull = (measured @ rows).ravel() / NOISE_MM**2
    return LinearGaussianSystem(np.asarray(information), pull), high * wave[-1]


def test_a_breath_is_told_that_began_before_and_ended_after_the_scan() -> None:
    """Seen for half a second at the beginning and at the end, it is known in the middle."""
    moments = np.array([0, 1, 2, 3, 12, 13, 14, 15])
    for period_s in (3.0, 4.5):
        system, truth = seen(period_s, 1.4, moments)
        alike = estimate_breath(system, BREATHS, COURSES.middle).mode_covariance
        prior = np.kron(np.eye(FIELDS), np.linalg.inv(alike))
        found = np.linalg.solve(system.information + prior, system.vector)
        error = found.reshape(FIELDS, -1) @ COURSES.middle - truth
        # What is not periodic is not known between.
        assert np.sqrt(np.mean(error**2)) < 1.2 * IRREGULAR * np.sqrt(np.mean(SIZES_MM**2))


def breathe(seconds: Array, length_s: float, begun: float) -> Array:
    """A fast inspiration, an exponential expiration, a pause: chest 4 mm forward, mean removed."""
    every = np.linspace(0.0, 1.0, 500, endpoint=False)

    def height(share: Array) -> Array:
        rises = 0.5 - 0.5 * np.cos(np.pi * np.minimum(share / 0.35, 1.0))
        return np.asarray(4.0 * rises * np.exp(-np.maximum(share - 0.35, 0.0) / 0.15))

    return height(np.mod(seconds / length_s + begun, 1.0)) - height(every).mean()


@pytest.mark.parametrize("span_s", [0.45, 1.7])
def test_of_a_short_scan_a_breath_is_known_as_well_as_is_said(span_s: float) -> None:
    """Though nobody breathes in sines: of 40 breaths 95 in a hundred are within two sigmas."""
    rng = np.random.default_rng(5)
    seconds = np.linspace(0.0, span_s, 6)
    modes = TemporalModes.from_correlation(correlate_breath, seconds.tolist(), 0.5 * span_s)
    breaths = Breaths.from_modes(modes, seconds.tolist(), 0.5 * span_s)
    errors = []
    for _ in range(40):
        length_s, begun = 3.75 * np.exp(0.2 * rng.standard_normal()), rng.random()
        true = breathe(np.append(seconds, 0.5 * span_s), length_s, begun)
        # Only changes are seen: a shift of all moments is the person's own.
        rows = modes.values - modes.values.mean(axis=0)
        seen_mm = true[:-1] - true[:-1].mean() + NOISE_MM * rng.standard_normal(6)
        information = np.kron(np.diag([1.0, 0.0, 0.0]), rows.T @ rows) / NOISE_MM**2
        # Fields carry the surface back.
        vector = np.kron([-1.0, 0.0, 0.0], rows.T @ seen_mm) / NOISE_MM**2
        found = estimate_breath(
            LinearGaussianSystem(np.asarray(information), vector), breaths, modes.middle
        )
        errors.append((-found.at_middle[0] - true[-1]) / np.sqrt(found.covariance[0, 0]))
    assert np.mean(np.abs(errors) < 1.96) >= 0.9
    assert np.sqrt(np.mean(np.square(errors))) > 0.4, "nor is more left open than is"


def test_without_times_a_girth_holds_breaths_of_every_depth_and_moment() -> None:
    """All around moves outwards as the front does, give or take 0.6 of it."""
    rng, count = np.random.default_rng(0), 100_000
    depth = 0.25 * rng.uniform(2.0, 8.0, count) * (1.0 + 0.6 * rng.standard_normal(count))
    kind = SimpleNamespace(fields=np.full((4, 12, 2), [1.0, 0.6]))
    body: Any = SimpleNamespace(
        centres=np.zeros((4, 3)), normals=np.eye(3)[[0, 1, 0, 1]], breath=None, kind=lambda _: kind
    )
    sigma = _find_offset_to_mean_breath(body, body, np.zeros(4), timed=False).sigma_mm
    highest = np.quantile(depth * breathe(rng.random(count), 1.0, 0.0), 0.975)
    np.testing.assert_allclose(1.96 * sigma, highest, rtol=0.03)


@pytest.mark.parametrize("deep_mm", [0.7, 1.4, 2.8])
def test_a_breath_is_as_deep_as_it_shows(deep_mm: float) -> None:
    system, _ = seen(3.6, deep_mm, np.arange(16))
    alike = estimate_breath(system, BREATHS, COURSES.middle).mode_covariance
    mean = COURSES.values @ alike @ COURSES.values.T
    assert np.sqrt(np.mean(np.diag(mean))) == pytest.approx(deep_mm, rel=0.6)


def test_who_does_not_breathe_is_hardly_moved() -> None:
    system, _ = seen(3.6, 0.0, np.arange(16))
    found = estimate_breath(system, BREATHS, COURSES.middle)
    assert np.abs(found.at_middle).max() < 1.5 * NOISE_MM


def test_of_nothing_seen_every_breath_is_as_likely() -> None:
    count = FIELDS * COURSES.count
    nothing = LinearGaussianSystem(np.zeros((count, count)), np.zeros(count))
    found = estimate_breath(nothing, BREATHS, COURSES.middle)
    every = BREATHS.waves @ np.swapaxes(BREATHS.waves, 1, 2) + BREATHS.irregular
    alike = np.mean(SIZES_MM**2) * np.einsum("kij,k->ij", every, BREATHS.priors)
    np.testing.assert_allclose(found.mode_covariance, alike, atol=1e-12)
    assert found.at_middle[0] == 0.0
    assert found.covariance[0, 0] == pytest.approx(COURSES.middle @ alike @ COURSES.middle)
