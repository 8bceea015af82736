from dataclasses import replace

import numpy as np
import pytest
from ring import ring_of_cameras, ring_rig, ring_views

from bodyscan.errors import FailedWork
from bodyscan.registration.halves import compare_halves, split_shots
from bodyscan.registration.rig_solve import solve_rig


def placed_ring(seed=0, shots=40, spoil=None):
    placings, cameras = ring_of_cameras(heights=(700, 1200))
    views, _ = ring_views(placings, cameras, shots=shots, seed=seed)
    views = [spoil(view) for view in views] if spoil else views
    rig = ring_rig(placings)
    return rig, solve_rig(rig, views, cameras).value


def test_honest_halves_differ_by_what_they_promise():
    found = [compare_halves(*placed_ring(seed), seed=seed) for seed in range(5)]
    ratios = [comparison.over_expected for comparison in found]
    # 5 x 30 independent normalised differences: 1 +- 0.06, and covariances good to 15 % or so.
    assert 0.8 < np.sqrt(np.mean(np.square(ratios))) < 1.25
    shifts = np.concatenate([c.shifts_mm / c.sigmas_mm for c in found])
    assert 0.7 < np.sqrt(np.mean(shifts**2)) < 1.35  # components of one pair go together: wider


def test_the_frame_itself_is_taken_out():
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


def test_errors_that_the_covariance_does_not_know_show():
    """All corners of a view 0.1 px aside, another way in each: 48 corners then tell no more than
    one, so that 0.03 px of noise promises far too much."""
    rng = np.random.default_rng(8)

    def aside(view):
        return replace(view, pixels=view.pixels + rng.normal(0.0, 0.1, 2))

    assert compare_halves(*placed_ring(spoil=aside)).over_expected > 1.5


def test_halves_are_seeded_disjoint_and_whole():
    _, placed = placed_ring()
    names = sorted(placed.rig_from_camera)
    first, second = split_shots(placed.views, names, seed=4)
    assert (first, second) == split_shots(placed.views, names, seed=4)
    assert (first, second) != split_shots(placed.views, names, seed=5)
    assert not set(first) & set(second)
    assert set(first) | set(second) == {view.shot for view in placed.views}
    assert abs(len(first) - len(second)) <= 1


def test_shots_that_cannot_be_halved_are_refused():
    rig, placed = placed_ring()
    only = min(view.shot for view in placed.views if view.pair == "p3-1")
    lonely = tuple(v for v in placed.views if v.pair != "p3-1" or v.shot == only)
    with pytest.raises(FailedWork, match="halved"):
        compare_halves(rig, replace(placed, views=lonely))
