"""How far a subject is believed to move, and what becomes of pairs that want to move farther."""

from __future__ import annotations

import numpy as np
import pytest

from bodyscan.alignment.sway_prior import (
    SwayPrior,
    compute_centre_shifts,
    reject_large_motions,
    select_tighter,
)
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.geometry.uncertainty import PoseCovariance
from bodyscan.settings import BODY_CENTRE_MM

PAIRS = ("p1", "p2")
PRIOR = SwayPrior(shift_mm=1.0, rotation_deg=0.5, min_scale=0.3, max_scale=4.0)
EXACT_BOARDS = PoseCovariance(PAIRS, np.zeros((12, 12)))


def shifted(*mm: float) -> np.ndarray:
    """Motions of pairs along x."""
    return np.array([[0.0, 0.0, 0.0, x, 0.0, 0.0] for x in mm])


def test_what_is_found_is_believed_within_bounds() -> None:
    assert PRIOR.scale(shifted(0.0, 0.0)) == 0.3
    assert PRIOR.scale(shifted(2.0, -2.0)) == pytest.approx(1.5 * 2.0 / np.sqrt(3.0))
    usual = SwayPrior(shift_mm=2.0, rotation_deg=0.5, min_scale=0.3, max_scale=4.0)
    assert usual.scale(shifted(2.0, -2.0)) == pytest.approx(0.5 * PRIOR.scale(shifted(2.0, -2.0)))
    assert PRIOR.scale(shifted(90.0, -90.0)) == 4.0
    assert SwayPrior(0.0, 0.0, 0.3, 4.0).scale(shifted(5.0, -5.0)) == 1.0


def test_a_turn_about_the_bodys_centre_leaves_the_centre_where_it_is() -> None:
    turn = RigidTransform.from_rotation_vector([0.0, 0.1, 0.0], np.zeros(3))
    centre = np.array(BODY_CENTRE_MM)
    about_centre = np.concatenate([[0.0, 0.1, 0.0], -np.cross([0.0, 0.1, 0.0], centre)])
    assert np.abs(compute_centre_shifts(about_centre[None])).max() < 1e-9
    assert np.abs(turn.apply(centre) - centre).max() > 50.0
    # The prior allows that turn as freely as any other, and the shift it would be without.
    covariance = PRIOR.covariance(PAIRS, EXACT_BOARDS)[:6, :6]
    sigmas = np.sqrt(about_centre @ np.linalg.solve(covariance, about_centre))
    assert sigmas == pytest.approx(0.1 / np.radians(0.5), rel=1e-6)


def test_pairs_are_independent_and_scale_with_what_was_found() -> None:
    once, twice = (PRIOR.covariance(PAIRS, EXACT_BOARDS, scale) for scale in (1.0, 2.0))
    assert not once[:6, 6:].any()
    np.testing.assert_allclose(twice, 4.0 * once)


def test_a_pair_that_wants_too_far_stays_where_it_was() -> None:
    covariance = np.eye(12)
    kept, refused = reject_large_motions(PAIRS, shifted(3.0, 30.0), covariance, limit_sigmas=5.0)
    np.testing.assert_array_equal(kept, shifted(3.0, 0.0))
    assert refused == {"p2": pytest.approx(30.0 / np.sqrt(6.0))}


def test_a_pair_that_nothing_ties_is_known_as_the_boards_and_a_sway_say() -> None:
    """1 mm of sway at the body's centre, besides the boards' 0.1 mm."""
    known = PoseCovariance(("p1", "p2", "p3"), 0.1**2 * np.eye(18))
    loose = SwayPrior(1.0, 0.0, 0.3, 4.0).loosen(known, ["p2"])
    for tied in ("p1", "p3"):
        assert np.array_equal(loose.marginal(tied), known.marginal(tied))
    added = loose.marginal("p2") - known.marginal("p2")
    assert np.sqrt(np.diag(added))[3:] == pytest.approx([1.0, 1.0, 1.0], rel=1e-3)


def test_what_all_pairs_share_is_not_between_two() -> None:
    shared, own = 4.0 * np.eye(6), 0.01 * np.eye(6)
    known = PoseCovariance(("p1", "p2", "p3"), np.kron(np.ones((3, 3)), shared).astype(float))
    known.matrix[12:, 12:] += own
    assert np.allclose(known.relative("p1", "p2"), 0.0)
    assert np.allclose(known.relative("p2", "p3"), own)


@pytest.mark.parametrize(("first_mm", "second_mm"), [(0.1, 0.2), (0.2, 0.1)])
def test_of_two_covariances_the_one_that_puts_the_body_off_by_less_counts(
    first_mm: float, second_mm: float
) -> None:
    """Pairs that nothing ties have no say: their sway is the prior's, whichever is taken."""
    known = np.diag([0.0, 0.0, 0.0, 1.0, 1.0, 1.0] * 2 + [0.0] * 6)
    loose = np.diag([0.0] * 15 + [1.0, 1.0, 1.0])
    one = PoseCovariance(("a", "b", "c"), first_mm**2 * known + 4.0 * loose)
    other = PoseCovariance(("a", "b", "c"), second_mm**2 * known + loose)
    assert select_tighter(one, other, ["a", "b"]) is (one if first_mm < second_mm else other)
    assert select_tighter(one, other, []) is one, "nothing ties any"
