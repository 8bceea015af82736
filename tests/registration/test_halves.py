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
from bodyscan.registration.halves import compare_halves, split_shots
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
    # 3 x 15 links that share five pairs each, so that 1 +- 0.15; covariances good to 15 % or so.
    assert 0.7 < np.sqrt(np.mean(np.square(ratios))) < 1.35


def test_the_frame_itself_is_taken_out() -> None:
    """The same differences whichever pair holds the frame; the holder, too, may differ."""
    rig, placed = placed_ring()
    comparison = compare_halves(rig, placed, seed=1)
    other = rig.model_copy(update={"rig_frame": rig.rig_frame.model_copy(update={"pair": "p2-2"})})
    again = compare_halves(other, placed, seed=1)
    assert comparison.shifts_mm.min() > 0.001
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
