from collections.abc import Callable
from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from ring import ring_of_cameras, ring_rig, ring_views
from seen_boards import seen_boards

from bodyscan.calibration.board_views import LocatedView
from bodyscan.errors import FailedWork
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.geometry.uncertainty import PoseCovariance
from bodyscan.registration import halves
from bodyscan.registration.halves import (
    _centre_sigmas,
    _common_motion_projector,
    _normalized_rms,
    compare_halves,
    split_shots,
)
from bodyscan.registration.rig_solve import RigSolution, solve_rig
from bodyscan.rig.rig import Rig
from bodyscan.workflows.find_boards import calibrate_cameras, locate_views


@cache
def placed_ring(
    seed: int = 0, shots: int = 40, spoil: Callable[[LocatedView], LocatedView] | None = None
) -> tuple[Rig, RigSolution]:
    placings, cameras = ring_of_cameras(heights=(700, 1200))
    views, _ = ring_views(placings, cameras, shots=shots, seed=seed)
    views = [spoil(view) for view in views] if spoil else views
    rig = ring_rig(placings)
    return rig, solve_rig(rig, views, cameras).value


def test_honest_halves_differ_by_what_they_promise() -> None:
    found = [compare_halves(*placed_ring(seed), seed=seed) for seed in range(3)]
    ratios = [comparison.over_expected for comparison in found]
    # 3 x 30 independent normalised differences: 1 +- 0.08, and covariances good to 15 % or so.
    assert 0.8 < np.sqrt(np.mean(np.square(ratios))) < 1.25
    shifts = np.concatenate([c.shifts_mm / c.sigmas_mm for c in found])
    assert 0.7 < np.sqrt(np.mean(shifts**2)) < 1.35  # components of one pair go together: wider


def test_the_frame_itself_is_taken_out() -> None:
    """The same differences whichever pair holds the frame; the holder, too, may differ."""
    rig, placed = placed_ring()
    comparison = compare_halves(rig, placed, seed=1)
    other = rig.model_copy(update={"rig_frame": rig.rig_frame.model_copy(update={"pair": "p2-2"})})
    again = compare_halves(other, placed, seed=1)
    holder = comparison.names.index("p1-1")
    assert np.linalg.norm(comparison.shifts_mm[holder]) > 0.01
    # Second-order in motions of 1e-4 radians, and the solver's own tolerance.
    np.testing.assert_allclose(comparison.shifts_mm, again.shifts_mm, atol=5e-3)
    np.testing.assert_allclose(comparison.sigmas_mm, again.sigmas_mm, rtol=0.02)


def test_errors_that_the_corners_of_a_view_share_are_in_the_covariance() -> None:
    """All corners of a view 0.1 px aside, another way in each: 48 corners then tell no more than
    one, so that 0.03 px of noise by itself would promise far too much."""
    rng = np.random.default_rng(8)

    def aside(view: LocatedView) -> LocatedView:
        return replace(view, pixels=view.pixels + rng.normal(0.0, 0.1, 2))

    rig, placed = placed_ring(spoil=aside)
    assert (
        placed.variance_inflation > 9.0
    )  # variances: the halves would lie three times as far apart
    ratios = [compare_halves(rig, placed, seed=seed).over_expected for seed in range(3)]
    assert 0.7 < np.sqrt(np.mean(np.square(ratios))) < 1.4  # cut in three ways, one set of errors


def test_independent_corners_have_no_excess() -> None:
    assert (
        placed_ring()[1].variance_inflation < 1.3
    )  # of 30 places with some 20 freedoms each: 1 +- 0.06


def test_halves_are_seeded_disjoint_and_whole() -> None:
    _, placed = placed_ring()
    names = sorted(placed.rig_from_camera)
    tied, first, second = split_shots(placed.views, names, seed=4)
    assert (tied, first, second) == split_shots(placed.views, names, seed=4)
    assert (first, second) != split_shots(placed.views, names, seed=5)[1:]
    assert list(tied) == names
    assert not set(first) & set(second)
    assert set(first) | set(second) == {view.shot for view in placed.views}
    assert abs(len(first) - len(second)) <= 1


def test_a_pair_that_a_half_does_not_tell_of_is_left_out_and_named() -> None:
    rig, placed = placed_ring()
    own = sorted({view.shot for view in placed.views if view.pair == "p3-1"})
    few = tuple(v for v in placed.views if v.pair != "p3-1" or v.shot in own[:5])
    found = compare_halves(rig, replace(placed, views=few))
    assert found.excluded == ("p3-1",)
    assert "p3-1" not in found.names
    assert len(found.names) == 5
    assert "without p3-1, not known from a half" in found.summary


def test_a_pair_that_does_not_fit_in_a_half_is_left_out_and_named() -> None:
    """Moved in most of one half's shots: the half's solve drops it, where all shots may keep it."""
    rig, placed = placed_ring()
    _, first, _ = split_shots(placed.views, sorted(placed.rig_from_camera))
    rng = np.random.default_rng(3)

    def moved(view: LocatedView) -> LocatedView:
        shift = RigidTransform.from_rotation_vector(np.zeros(3), rng.normal(0.0, 20.0, 3))
        pixels = placed.cameras[view.pair].project(
            (shift @ view.camera_from_board).apply(view.points)
        )
        return replace(view, pixels=pixels, camera_from_board=shift @ view.camera_from_board)

    views = tuple(
        moved(view) if view.pair == "p2-2" and view.shot in first else view for view in placed.views
    )
    found = compare_halves(rig, replace(placed, views=views))
    assert found.excluded == ("p2-2",)
    # Of the other pairs, 30 differences that are not quite independent: 1 +- 0.15 at least.
    assert 0.65 < found.over_expected < 1.4


@pytest.mark.parametrize("shots", [2, 3, 5])
def test_so_few_shots_are_not_halved(shots: int) -> None:
    rig, placed = placed_ring()
    usual = sorted({view.shot for view in placed.views})[:shots]
    views = tuple(view for view in placed.views if view.shot in usual)
    with pytest.raises(FailedWork, match=f"{shots} shots cannot be halved"):
        compare_halves(rig, replace(placed, views=views))


def test_halves_that_know_far_less_than_the_whole_say_nothing() -> None:
    """All boards but one parallel to each other: the half without that one knows no focal length."""
    seen = seen_boards(3, shots=9, tilted=1)
    rig = seen.rig
    cameras = calibrate_cameras(rig, seen.views).value
    located = locate_views(rig, seen.views, cameras).value
    placed = solve_rig(rig, located, {name: one.camera for name, one in cameras.items()}).value
    with pytest.raises(FailedWork, match="too few boards, or too much alike"):
        compare_halves(rig, placed)


def test_no_two_pairs_that_both_halves_tie_together_are_refused() -> None:
    rig, placed = placed_ring()
    only = min(view.shot for view in placed.views if view.pair == "p3-1")
    views = [v for v in placed.views if v.pair in ("p3-1", "p1-1")]
    lonely = tuple(v for v in views if v.pair != "p3-1" or v.shot == only)
    with pytest.raises(FailedWork, match="halved"):
        compare_halves(rig, replace(placed, views=lonely))


@pytest.mark.parametrize("seed", range(8))
def test_of_many_draws_those_halves_are_taken_that_tie_most_pairs(seed: int) -> None:
    """A pair that took six of twelve shots: no more than two draws of five give either half three."""
    seen = [
        SimpleNamespace(pair=pair, shot=f"s{k:02d}", target=(f"s{k:02d}", "b"))
        for pair, shots in (("a", range(12)), ("b", range(12)), ("c", range(6)))
        for k in shots
    ]
    tied, first, second = split_shots(cast(Any, seen), ("a", "b", "c"), seed=seed)
    assert tied == ("a", "b", "c")
    assert (len(first), len(second)) == (6, 6)
    assert all(sum(shot < "s06" for shot in half) == 3 for half in (first, second))
    # Where no draw ties all three, the two that most draws tie.
    few = [view for view in seen if view.pair != "c" or view.shot < "s05"]
    assert split_shots(cast(Any, few), ("a", "b", "c"), seed=seed)[0] == ("a", "b")


@pytest.mark.parametrize(("times", "told"), [(4.9, True), (5.1, False)])
def test_halves_that_know_the_rig_five_times_worse_say_nothing_of_the_whole(
    monkeypatch: pytest.MonkeyPatch, times: float, told: bool
) -> None:
    placings, _ = ring_of_cameras()
    names = tuple(sorted(placings))
    known = np.diag(np.tile([1e-16] * 3 + [1e-4] * 3, len(names)))
    half = PoseCovariance(names, 0.5 * times**2 * known)
    monkeypatch.setattr(halves, "_solve_half", lambda *of: (dict(placings), half))
    seen = [
        SimpleNamespace(pair=p, shot=f"s{k}", target=(f"s{k}", "b"))
        for p in names
        for k in range(8)
    ]
    placed: Any = SimpleNamespace(
        rig_from_camera=placings, views=seen, covariance=PoseCovariance(names, known)
    )
    if told:
        found = compare_halves(ring_rig(placings), placed)
        assert found.over_expected == pytest.approx(0.0, abs=1e-6)
        # But for what all have in common, a twelfth of the variance and what turns them alike.
        assert found.sigmas_mm == pytest.approx(times * 0.01, rel=0.2)
        return
    with pytest.raises(FailedWork, match=r"halves of the shots should differ by 0\.0"):
        compare_halves(ring_rig(placings), placed)


def test_differences_are_counted_in_sigmas_with_their_correlation() -> None:
    """Two that go together by four fifths: 1 and -1 sigma is as far as five sigmas of variance 1."""
    together = np.array([[1.0, 1.6], [1.6, 4.0]])
    assert _normalized_rms(np.array([1.0, -2.0]), together) == pytest.approx(np.sqrt(5.0))
    assert _normalized_rms(np.array([-1.0, 2.0]), together) == pytest.approx(np.sqrt(5.0))
    # (1, 1) sigmas have a square of 2 / 1.8 in the direction that has it all, of two.
    assert _normalized_rms(np.array([1.0, 2.0]), together) == pytest.approx(np.sqrt(1.0 / 1.8))
    # What the frame took out, here their difference, counts neither way.
    assert _normalized_rms(np.array([3.0, 1.0]), np.ones((2, 2))) == pytest.approx(2.0)


def test_the_frame_taken_out_of_many_pairs_leaves_the_rounding_of_their_largest_variance() -> None:
    """Forty that go together have 40 times their own variance in common, which is known to 40 times
    its rounding: 1e-8 of their own is nothing, and a difference there says nothing."""
    together = (1.0 - 1e-8) * np.ones((40, 40)) + 1e-8 * np.eye(40)
    alike, apart = np.ones(40), np.zeros(40)
    apart[:2] = 1e-3, -1e-3
    assert _normalized_rms(alike + apart, together) == pytest.approx(1.0, rel=1e-6)


def test_a_centres_sigma_is_that_of_its_shift_and_of_the_turn_about_the_origin() -> None:
    covariance = np.zeros((12, 12))
    covariance[range(6), range(6)] = [1e-6, 4e-6, 9e-6, 0.25, 0.25, 0.25]
    covariance[range(6, 12), range(6, 12)] = [1e-6, 1e-6, 1e-6, 1.0, 4.0, 9.0]
    found = _centre_sigmas(covariance, np.array([[0.0, 0.0, 1000.0], [0.0, 0.0, 0.0]]))
    # A turn about x moves what is 1000 mm up along y, and about y along x; about z nowhere.
    np.testing.assert_allclose(found**2, [[4.25, 1.25, 0.25], [1.0, 4.0, 9.0]])


def test_what_all_pairs_do_alike_is_taken_out_and_half_of_what_one_of_two_does() -> None:
    centres = np.array([[1300.0, 0.0, 900.0], [-700.0, 1100.0, 400.0]])
    ahead = -centres / np.linalg.norm(centres, axis=1)[:, None]
    alike = np.tile([1e-3, -2e-3, 5e-4, 0.3, -0.2, 0.1], 2)
    # Of motions up to 0.3, solved to rounding.
    np.testing.assert_allclose(_common_motion_projector(centres, ahead) @ alike, 0.0, atol=1e-12)
    # Twins in either place, of which one moves and the other does not.
    keep = _common_motion_projector(centres[[0, 0, 1, 1]], ahead[[0, 0, 1, 1]])
    moves = np.kron([1.0, 0.0, 1.0, 0.0], alike[:6])
    np.testing.assert_allclose(keep @ moves, moves - 0.5 * np.tile(alike, 2), atol=1e-12)
