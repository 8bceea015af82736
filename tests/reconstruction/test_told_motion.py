"""Motion told from boundaries alone, on a ball that moves by known speeds."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from moving_ball import BITS, CAMERA, CENTRE, STRIPES, bit_of, seen_boundaries, sheets
from ray_cast_scan import load_rig

from bodyscan.arrays import Array
from bodyscan.reconstruction import sequence_moments as sequence_moments_file
from bodyscan.reconstruction.sequence_moments import sequence_moments
from bodyscan.reconstruction.told_motion import (
    CHANCE,
    _band_share,
    _Teeth,
    _velocity,
    _weights,
    tell_motion,
)
from bodyscan.rig.frame_names import FrameNames
from bodyscan.stripes.boundaries import Boundaries
from bodyscan.stripes.codes.gray import Gray
from bodyscan.stripes.codes.light_section import LightSection
from bodyscan.stripes.comb import Comb, find_comb
from bodyscan.stripes.one_moment import Moments, StripeMotion, carry_to_moment

TIMES = np.linspace(1.0 - BITS, 0.0, BITS) / 60.0
"""Each pattern beside its inverse at 120 images a second; the finest are the last."""
STILL = np.zeros(3)


def carry(
    seen: Boundaries, times: Array = TIMES, instead: Array | None = None
) -> tuple[Boundaries, StripeMotion | None, float]:
    def told(comb: Comb) -> StripeMotion | None:
        return tell_motion(CAMERA, sheets(), comb)

    moments = Moments({"pattern": times}, float(times[-1]), told)
    if instead is not None:
        moments = replace(moments, instead=Moments({"pattern": instead}, float(instead[-1]), told))
    return carry_to_moment(seen, bit_of(seen.index), moments, turned=True)


def errors(carried: Boundaries) -> Array:
    """Against where the ball at rest has the same boundaries, px."""
    still = seen_boundaries(STILL, TIMES, seed=None)
    here, there = (1000 * each.line + each.index for each in (carried, still))
    _, one, other = np.intersect1d(here, there, return_indices=True)
    return carried.position[one] - still.position[other]


@pytest.mark.parametrize(
    "velocity", [(0.0, 0.0, 8.0), (6.0, 3.0, -4.0)], ids=["in depth", "to all sides"]
)
def test_a_balls_velocity_is_told_and_its_boundaries_are_carried_to_one_moment(
    velocity: tuple[float, ...],
) -> None:
    true = np.array(velocity)
    seen = seen_boundaries(true, TIMES)
    carried, motion, _ = carry(seen)
    assert motion is not None
    assert motion.is_significant
    jacobian = np.hstack([np.cross(CENTRE, np.eye(3)), np.eye(3)])  # of the centre's velocity
    sigma = np.sqrt(np.diagonal(jacobian @ motion.velocity.covariance @ jacobian.T))
    off = motion.velocity.at(CENTRE) - true
    assert np.all(np.abs(off) < 4.0 * sigma)
    assert np.all(sigma < 1.5)  # mm/s
    # With teeth 0.040 and 0.028 px, of which 0.020 are noise; without them the noise is left.
    before, after = errors(seen), errors(carried)
    assert np.sqrt(np.mean(before**2)) > 0.027
    assert np.sqrt(np.mean(after**2)) < 0.0205
    assert abs(np.mean(after)) < 0.0015


def test_what_a_ball_does_about_its_own_middle_is_not_seen_and_not_claimed() -> None:
    _, motion, _ = carry(seen_boundaries(np.array([0.0, 0.0, 8.0]), TIMES))
    assert motion is not None
    turn = np.sqrt(np.diagonal(motion.velocity.covariance)[:3])
    assert np.all(
        turn > 0.011
    )  # of the prior's 0.05 rad/s; a velocity of 8 mm/s would be 0.009 off


def test_a_ball_that_stands_still_keeps_its_boundaries_to_the_bit() -> None:
    seen = seen_boundaries(STILL, TIMES)
    carried, motion, farthest = carry(seen)
    assert motion is not None
    assert not motion.is_significant
    assert carried is seen
    assert farthest == 0.0


def test_a_motion_that_is_not_rigid_becomes_a_field() -> None:
    # The left half comes nearer at 15 mm/s, the right half goes, smoothly between.
    along = np.arange(CAMERA.width)
    beside = np.broadcast_to(15.0 * np.tanh((along - 80) / 15.0), (CAMERA.height, CAMERA.width))
    seen = seen_boundaries(np.array([0.0, 0.0, 5.0]), TIMES, beside=beside)
    carried, motion, _ = carry(seen)
    assert motion is not None
    # Places on both sides tell of it, each by itself.
    told, left = motion.velocity.seen, motion.velocity.seen.points[:, 0] < -40.0
    right = told.points[:, 0] > 40.0
    assert np.average(told.speed[left], weights=told.sigma[left] ** -2.0) == pytest.approx(
        -10, abs=2
    )
    assert np.average(told.speed[right], weights=told.sigma[right] ** -2.0) == pytest.approx(
        20, abs=2
    )
    before, after = errors(seen), errors(carried)
    assert np.sqrt(np.mean(before**2)) > 0.05
    assert np.sqrt(np.mean(after**2)) < 0.022


def test_without_a_clock_the_order_is_enough() -> None:
    seen = seen_boundaries(np.array([0.0, 0.0, 8.0]), TIMES)
    by_clock, _, _ = carry(seen)
    by_order, motion, _ = carry(seen, np.arange(BITS, dtype=float))
    assert motion is not None
    # Priors per image are wider than per second, and rule nothing here.
    np.testing.assert_allclose(by_order.position, by_clock.position, atol=4e-3)
    assert motion.velocity.at(CENTRE)[2] == pytest.approx(8.0 / 60.0, rel=0.1)


def test_how_far_windows_err_is_told_by_them_and_not_by_what_they_say_of_it() -> None:
    seen = seen_boundaries(np.array([0.0, 0.0, 8.0]), TIMES)
    comb = find_comb(seen, TIMES[bit_of(seen.index)], turned=True)
    honest, boasting = (
        tell_motion(CAMERA, sheets(), replace(comb, sigma=factor * comb.sigma))
        for factor in (1.0, 0.25)
    )
    assert honest is not None
    assert boasting is not None
    np.testing.assert_allclose(boasting.velocity.seen.sigma, honest.velocity.seen.sigma, rtol=1e-3)


def test_stripes_that_stray_by_themselves_are_not_taken_for_motion() -> None:
    stray = 0.02 * np.random.default_rng(53).standard_normal(200)  # px, along the whole of a stripe
    seen = seen_boundaries(STILL, TIMES)
    seen = replace(seen, position=seen.position + stray[seen.index])
    carried, motion, _ = carry(seen)
    assert motion is not None
    # Counted as if each column told them anew, these teeth are 9 sigmas.
    assert not motion.is_significant
    assert carried is seen


@pytest.mark.parametrize("seed", [6, 13, 25])
def test_nor_are_they_where_runs_begin_at_any_stripe(seed: int) -> None:
    """Windows cut anywhere had stripes in common with their neighbours, which hid how far these stray:
    of thirty such balls five, these among them, were told to move by 1.4 to 2.6 mm/s."""
    stray = 0.03 * np.random.default_rng(1000 + seed).standard_normal(200)
    seen = seen_boundaries(STILL, TIMES, seed=2000 + seed)
    seen = replace(seen, position=seen.position + stray[seen.index])
    _, motion, _ = carry(seen)
    assert motion is not None
    assert not motion.is_significant


def test_the_more_pairs_are_asked_the_clearer_each_has_to_be() -> None:
    code = Gray(stripes=STRIPES, direction="horizontal", inverses=True)
    frames = load_rig().frames
    frame_ms = {name: 8.0 * place for place, name in enumerate(frames.of_code(code))}
    pair: Any = SimpleNamespace(camera=CAMERA, sheets=sheets(), crossing=None)
    seen = seen_boundaries(np.array([0.0, 0.0, 1.0]), TIMES)
    comb = find_comb(seen, TIMES[bit_of(seen.index)], turned=True)
    told = []
    for pairs in (1, 64):
        motion = sequence_moments(pair, code, frames, frame_ms, pairs)[0].told(comb)
        assert motion is not None
        told.append(motion.is_significant)
    assert told == [True, False]


def test_of_two_orders_the_one_that_explains_the_teeth_is_believed() -> None:
    places = np.array([5.0, 3.0, 1.0, 0.0, 2.0, 4.0, 6.0])  # no line of the bits' numbers
    seen = seen_boundaries(np.array([0.0, 0.0, 8.0]), (places - places[-1]) / 60.0)
    by_number = np.arange(BITS, dtype=float)
    for usual, instead in ((by_number, places), (places, by_number)):
        carried, _, _ = carry(seen, usual, instead)
        # With the other order alone 0.03 px and more.
        assert np.sqrt(np.mean(errors(carried) ** 2)) < 0.0205


def test_teeth_that_no_smooth_motion_explains_go_into_the_sigmas() -> None:
    # Patches of 24 px go to and fro on one side: as wide as cells, finer than the knots see.
    patches = np.zeros((CAMERA.height, CAMERA.width))
    patches[:, :48] = np.kron(
        [[1, -1], [-1, 1], [1, -1], [-1, 1], [1, -1]], np.full((24, 24), 40.0)
    )
    patches = cv2.GaussianBlur(patches, (0, 0), 3.0)  # lines must not fold
    seen = seen_boundaries(np.array([0.0, 0.0, 8.0]), TIMES, beside=patches)
    carried, motion, _ = carry(seen)
    assert motion is not None
    grid = motion.doubt[:, : 48 // motion.cell_px], motion.doubt[:, 100 // motion.cell_px :]
    assert np.median(grid[0]) > 5.0 * np.median(grid[1])
    late = (bit_of(carried.index) < BITS - 2) & (carried.line < 40)
    assert np.median(carried.sigma_px[late] / seen.sigma_px[late]) > 1.5


@pytest.mark.parametrize(("lasts_ms", "most_mm"), [(10.0, 2.0), (3000.0, 120.0)])
def test_nobody_moves_farther_than_there_is_time_for(lasts_ms: float, most_mm: float) -> None:
    """At 40 mm a second, and by no leap that is too short to be named."""
    code, names = Gray(stripes=64, direction="vertical"), FrameNames()
    frame_ms = dict(zip(names.of_code(code), np.linspace(500.0, 500.0 + lasts_ms, 12), strict=True))
    pair: Any = SimpleNamespace(camera=CAMERA, sheets=sheets(), crossing=None)
    (moments,) = sequence_moments(pair, code, names, frame_ms)
    assert moments.most_mm == pytest.approx(most_mm)


def test_what_all_windows_share_is_not_known_of_a_velocity_along_the_view() -> None:
    middle = np.array([30.0, -60.0, 900.0])
    fit: Any = SimpleNamespace(
        twist=np.array([0.1, 0, 0, 3.0, 0, 4.0]), covariance=np.zeros((9, 9))
    )
    teeth: Any = SimpleNamespace(common=0.4, middle=middle)
    seen: Any = None
    found = _velocity(fit, teeth, seen, 0.0)
    along = 0.4 * middle / 900.0
    np.testing.assert_allclose(found.covariance[3:, 3:], np.outer(along, along), atol=1e-12)
    np.testing.assert_allclose(found.covariance[:3], 0.0, atol=1e-12)
    # About the middle it turns by (0.1, 0, 0) and moves by (3, 0, 4).
    moved = np.cross(found.twist[:3], middle) + found.twist[3:]
    np.testing.assert_allclose(moved, [3.0, 0.0, 4.0], atol=1e-12)
    # A speed that may be off by a twentieth: of a turn of 0.1 and a shift of 5.
    here: Any = SimpleNamespace(common=0.0, middle=np.array([0.0, 0.0, 1e-9]))
    off = _velocity(fit, here, seen, 0.05)
    np.testing.assert_allclose(
        np.sqrt(np.diag(off.covariance)), [0.005] * 3 + [0.25] * 3, rtol=1e-6
    )


@pytest.mark.parametrize("crossing", [1, 2])
def test_noise_says_of_one_rig_in_a_hundred_that_somebody_moved(
    crossing: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However many pairs are asked, and stripes of one direction or both."""
    asked: list[float] = []

    def look(pair: Any, code: Any, frames: Any, chance: float, when: Any) -> tuple[Moments, ...]:
        asked.append(chance)
        return (Moments({}, 0.0, None),)  # type: ignore[arg-type]

    monkeypatch.setattr(sequence_moments_file, "_moments", look)
    code: Any = SimpleNamespace(directions=("vertical", "horizontal")[:crossing])
    nothing: Any = None
    sequence_moments(nothing, code, nothing, {"a": 0.0, "b": 100.0}, pairs=16)
    assert 1.0 - (1.0 - asked[0]) ** (16 * crossing) == pytest.approx(CHANCE)


@pytest.mark.parametrize("inverses", [True, False])
def test_without_times_images_came_in_the_codes_order_or_in_that_in_which_it_is_best_shown(
    inverses: bool,
) -> None:
    """A second apart, for want of a better unit."""
    code = Gray(stripes=16, direction="vertical", inverses=inverses)
    pair: Any = SimpleNamespace(camera=CAMERA, sheets=sheets(), crossing=None)
    (usual,) = sequence_moments(pair, code, FrameNames(), None)
    assert usual.times["pattern"].tolist() == [0.0, 1.0, 2.0, 3.0]
    assert usual.instead is not None
    # The finest, bit 3, in the middle: 1, 3, 2, 0, each with its inverse behind it.
    apart = 2.0 if inverses else 1.0
    assert usual.instead.times["pattern"].tolist() == [3 * apart, 0.0, 2 * apart, apart]


def test_where_both_orders_are_the_same_there_is_no_other_to_try() -> None:
    code = LightSection(stripes=4, direction="vertical")
    pair: Any = SimpleNamespace(camera=CAMERA, sheets=sheets(), crossing=None)
    (moments,) = sequence_moments(pair, code, FrameNames(), None)
    assert moments.times["stripe"].tolist() == [0.0, 1.0, 2.0, 3.0]
    assert moments.instead is None


@pytest.mark.parametrize("bands", [6, 11])
def test_windows_of_stripes_that_stray_count_by_what_their_means_are_apart_beyond_noise(
    bands: int,
) -> None:
    """Means of 1 and -1 in turn have a variance of 2 from one to the next, of which a quarter is noise:
    of a weight of 4 an eighth is left."""
    band = np.repeat(np.arange(bands), 2)
    weights = np.tile([1.0, 3.0], bands)
    left = np.where(band % 2, 1.0, -1.0)
    share, independent = _band_share(band, left, weights)
    np.testing.assert_allclose(share, 1.0 / (1.0 + (2.0 - 0.25) * 4.0))
    # Each mean takes part in two differences: two thirds as many as there are.
    assert independent == pytest.approx(2.0 / 3.0 * (bands - 1))
    still, _ = _band_share(band, np.zeros(2 * bands), weights)
    np.testing.assert_allclose(still, 1.0)
    # Of the more clearly known ones more is believed.
    clear = np.where(band < 3, 100.0, 1.0) * weights
    assert _band_share(band, left, clear)[1] < independent


def test_five_bands_beside_another_are_enough_to_tell_that_they_stray() -> None:
    for bands, told in ((6, True), (5, False)):
        band = np.arange(bands)
        share, independent = _band_share(band, np.where(band % 2, 1.0, -1.0), np.full(bands, 4.0))
        assert bool(share[0] < 0.5) is told
        assert bool(np.isinf(independent)) is not told
    # Bands of which the next is missing are beside none.
    apart = np.arange(0, 20, 2)
    assert np.isinf(_band_share(apart, np.ones(10), np.full(10, 4.0))[1])


def test_windows_count_by_how_they_scatter_and_those_three_times_as_far_off_for_half() -> None:
    """Speeds of 2 and -2 sigmas, where no twist explains any, and one of 3 times their spread."""
    count = 21
    sigma = np.where(np.arange(count) % 2, 0.5, 2.0)
    spread = 2.0 / 0.6745
    off = np.where(np.arange(count) % 4 < 2, 2.0, -2.0)
    off[20] = 3.0 * spread
    nothing = np.zeros((count, 3))
    whole = np.zeros(count, np.int64)  # one band of stripes tells nothing of how bands stray
    teeth = _Teeth(
        np.arange(count), whole, sigma * off, sigma, sigma, np.zeros((count, 6)), nothing,
        nothing[0], 0.0,
    )  # fmt: skip
    weights, independent = _weights(teeth)
    assert np.isinf(independent)
    expected = 1.0 / (1.0 + (off / (3.0 * spread)) ** 2) / (sigma * spread) ** 2
    # A spread by the median to four digits.
    np.testing.assert_allclose(weights, expected, rtol=1e-3)
    assert weights[20] * (sigma[20] * spread) ** 2 == pytest.approx(0.5, rel=1e-3)
