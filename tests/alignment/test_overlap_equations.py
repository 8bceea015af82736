"""Equations of overlaps and of a pair that drifts, against what they are worked out from."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from bodyscan.alignment.displaced_poles import PairDrift, estimate_drift
from bodyscan.alignment.matching import Matches
from bodyscan.alignment.overlaps import compute_motion_covariance, linearize, solve_motions
from bodyscan.geometry.linear_gaussian import LinearGaussianSystem


def matches(distances: np.ndarray, seed: int = 0, sigma_mm: float = 0.2) -> Matches:
    rng = np.random.default_rng(seed)
    count = len(distances)
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    points = rng.uniform([-300, -200, 200], [300, 200, 1700], (count, 3))
    sigmas = np.full(count, sigma_mm)
    return Matches(points, normals, distances, sigmas, np.arange(count))


def by_motion(found: Matches) -> np.ndarray:
    """(M, 6): what a small motion of the source, a turn about the origin and a shift, adds."""
    return np.hstack([np.cross(found.points, found.normals), found.normals])


def test_every_distance_pulls_by_its_own_variance_and_the_spread_of_all() -> None:
    found = matches(np.where(np.arange(50) % 2, 0.1, -0.1))
    jacobian = by_motion(found)
    spread = 1.4826 * 0.1
    weight = 1.0 / (0.2**2 + spread**2 + 0.25 * 0.1**2)
    equations = linearize(found, 4.0)
    np.testing.assert_allclose(
        equations.information, weight * jacobian.T @ jacobian / 4.0, rtol=1e-9
    )
    np.testing.assert_allclose(
        -equations.vector, weight * jacobian.T @ found.distances / 4.0, rtol=1e-9
    )


def test_a_distance_far_beyond_the_others_counts_for_little() -> None:
    distances = np.full(51, 0.01)
    distances[50] = 100.0
    with_it, without = matches(distances), matches(distances[:50])
    one, other = (linearize(found, 1.0) for found in (with_it, without))
    # Cauchy: its pull is at most d / (d^2 / 4) = 4 / d, here 0.04; plainly it would be 2,000.
    pull = np.linalg.norm((one.vector - other.vector)[3:])
    assert pull == pytest.approx(0.04, rel=0.01)


def test_where_all_agree_exactly_no_weight_is_without_end() -> None:
    equations = linearize(matches(np.zeros(50), sigma_mm=0.0), 1.0)
    # A hundredth of a millimetre is the least that distances spread.
    assert np.trace(equations.information[3:, 3:]) == pytest.approx(50 / 0.01**2)


def test_motions_bring_what_overlaps_together_and_nothing_else() -> None:
    true = np.random.default_rng(3).normal(size=(3, 6)) * ([1e-3] * 3 + [1.0] * 3)
    true -= true.mean(axis=0)
    overlaps = {}
    for seed, (a, b) in enumerate([(0, 1), (1, 2)]):
        found = matches(np.zeros(400), seed)
        # Source a lies off by what a's motion has to take out, less b's.
        off = -by_motion(found) @ (true[a] - true[b])
        apart = Matches(found.points, found.normals, off, found.sigma_mm, found.source)
        overlaps[a, b] = linearize(apart, 1.0)
    wide = np.diag(([1.0] * 3 + [1e6] * 3) * 3)
    motion = solve_motions(overlaps, np.zeros((3, 6)), wide)
    # What all share stays near zero, where the prior holds it.
    np.testing.assert_allclose(motion, true, atol=1e-4)
    narrow = solve_motions(overlaps, np.zeros((3, 6)), 1e-12 * wide)
    assert np.abs(narrow).max() < 1e-3


def test_a_step_starts_from_the_motions_so_far() -> None:
    """Distances are those left after these motions: what is left to do is added to them."""
    found = matches(np.zeros(400))
    so_far = np.array([[1e-3, 0, 0, 0.5, 0, 0], [0, 0, 0, -0.5, 0, 0]])
    left = np.array([0.0, 1e-3, 0.0, 0.0, 0.2, 0.0])
    apart = Matches(
        found.points, found.normals, -by_motion(found) @ left, found.sigma_mm, found.source
    )
    wide = np.diag(([1.0] * 3 + [1e6] * 3) * 2)
    motion = solve_motions({(0, 1): linearize(apart, 1.0)}, so_far, wide)
    np.testing.assert_allclose(motion[0] - motion[1], so_far[0] - so_far[1] + left, atol=1e-4)


def test_a_pair_has_moved_where_chance_explains_it_once_in_ten_thousand_times() -> None:
    shifts = np.array([[1.0, 0.2, 0.0], [1.4, 0.0, 0.1], [1.2, -0.2, 0.3], [1.2, 0.0, 0.0]])
    drift = estimate_drift("p", shifts)
    np.testing.assert_allclose(drift.shift, [1.2, 0.0, 0.1])
    assert drift.shift_mm == pytest.approx(np.hypot(1.2, 0.1))
    # Of the mean: variances of all axes, over four scans.
    variance = (0.04 + 0.0 + 0.04 + 0.0) / 3 + 0.08 / 3 + 0.06 / 3
    assert drift.sigma_mm == pytest.approx(np.sqrt(variance / 4))
    assert drift.limit_mm == pytest.approx(np.sqrt(stats.f.isf(1e-4, 3, 9)) * np.sqrt(variance / 4))
    assert drift.moved is (drift.shift_mm > drift.limit_mm)


def test_what_does_not_vary_is_known_to_a_twentieth_and_believed_from_three_tenths() -> None:
    steady = estimate_drift("p", np.tile([0.1, 0.0, 0.0], (40, 1)))
    assert steady.sigma_mm == 0.05
    assert steady.limit_mm == pytest.approx(0.3)
    assert not steady.moved
    assert not PairDrift("p", (0.3, 0.0, 0.0), 0.05, 0.3).moved
    assert PairDrift("p", (0.0, 0.31, 0.0), 0.05, 0.3).moved


def test_two_scans_do_not_tell_a_pair_that_moved_from_a_person() -> None:
    few = estimate_drift("p", np.tile([9.0, 0.0, 0.0], (2, 1)))
    assert few.sigma_mm is None
    assert not few.moved
    assert estimate_drift("p", np.tile([9.0, 0.0, 0.0], (3, 1))).moved


def test_motions_are_known_by_the_prior_and_by_what_overlaps_say_of_their_difference() -> None:
    """Two pairs, each known to a, tied along x to b: their mean keeps a / sqrt(2), their difference
    has 1 / (1 / 2 a^2 + 1 / b^2); along y, of which the overlap says nothing, all stays."""
    a, b = 0.3, 0.1
    tie = LinearGaussianSystem(np.diag([0.0, 0.0, 0.0, b**-2, 0.0, 0.0]), np.zeros(6))
    found = compute_motion_covariance({(0, 1): tie}, a**2 * np.eye(12))
    mean, difference = np.zeros(12), np.zeros(12)
    mean[[3, 9]], difference[[3, 9]] = 0.5, (1.0, -1.0)
    assert mean @ found @ mean == pytest.approx(a**2 / 2.0)
    expected = 1.0 / (1.0 / (2.0 * a**2) + 1.0 / b**2)
    assert difference @ found @ difference == pytest.approx(expected)
    assert found[4, 4] == pytest.approx(a**2)
    assert found[4, 10] == pytest.approx(0.0, abs=1e-12)
