"""Slices of bodies whose girths are known from formulas."""

from __future__ import annotations

import numpy as np
import open3d as o3d
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_bodies import arrays, cylinder, ellipsoid, together
from scipy.special import ellipe

from bodyscan.mesh.slices import Loop, height_ranges, hull_mm, joined, loops_at, runs_of


@pytest.mark.parametrize("height", [55.0, 100.0, 123.4])  # 100 lies on a ring of vertices
def test_a_cylinder_is_cut_in_a_circle(height: float) -> None:
    (loop,) = loops_at(*cylinder(80.0, 0.0, 200.0), height)
    # 400 corners on a circle: shorter by pi^2 / (6 * 400^2), a hundred-thousandth.
    assert loop.girth_mm == pytest.approx(2 * np.pi * 80.0, rel=2e-5)
    assert loop.tape_mm == pytest.approx(2 * np.pi * 80.0, rel=2e-5)
    assert loop.area_mm2 == pytest.approx(np.pi * 80.0**2, rel=5e-5)
    assert loop.centre == pytest.approx([0.0, 0.0], abs=1e-6)


@given(share=st.floats(-0.9, 0.9))
def test_an_ellipsoid_is_cut_in_an_ellipse(share: float) -> None:
    (loop,) = loops_at(*ELLIPSOID, 250.0 * share)
    long, short = np.array([150.0, 90.0]) * np.sqrt(1.0 - share**2)
    girth = 4.0 * long * ellipe(1.0 - (short / long) ** 2)
    # 400 facets around and 200 from pole to pole: flat where the body is round.
    assert loop.girth_mm == pytest.approx(girth, rel=2e-4)
    assert loop.tape_mm == pytest.approx(girth, rel=2e-4)
    assert loop.area_mm2 == pytest.approx(np.pi * long * short, rel=4e-4)


ELLIPSOID = ellipsoid((150.0, 90.0, 250.0))


def test_a_hollow_is_followed_by_the_surface_and_spanned_by_the_tape() -> None:
    """A torus that stands upright, cut above its hole's bottom: two circles; the lying one: a ring."""
    vertices, faces = arrays(o3d.geometry.TriangleMesh.create_torus(100.0, 30.0, 200, 100))
    outer, inner = loops_at(vertices, faces, 0.0)
    assert outer.girth_mm == pytest.approx(2 * np.pi * 130.0, rel=1e-3)
    assert inner.girth_mm == pytest.approx(2 * np.pi * 70.0, rel=1e-3)
    assert outer.area_mm2 + inner.area_mm2 == pytest.approx(np.pi * (130.0**2 - 70.0**2), rel=2e-3)
    upright = vertices[:, [2, 0, 1]]
    one, other = loops_at(upright, faces, 0.0)
    for loop in (one, other):
        assert loop.girth_mm == pytest.approx(2 * np.pi * 30.0, rel=2e-3)
    assert sorted([one.centre[1], other.centre[1]]) == pytest.approx([-100.0, 100.0], abs=0.1)
    # Just above the hole's edge the two have run together, with a waist between them.
    (both,) = loops_at(upright, faces, 75.0)
    assert both.tape_mm < both.girth_mm - 5.0
    assert both.area_mm2 > 0


def test_legs_are_loops_of_their_own() -> None:
    legs = together(cylinder(70.0, 0.0, 700.0, y=90.0), cylinder(60.0, 0.0, 700.0, y=-90.0))
    left, right = loops_at(*legs, 333.0)
    assert left.girth_mm == pytest.approx(2 * np.pi * 70.0, rel=2e-5)
    assert right.girth_mm == pytest.approx(2 * np.pi * 60.0, rel=2e-5)
    assert left.centre[1] == pytest.approx(90.0)


def test_what_is_made_up_is_told() -> None:
    vertices, faces = ellipsoid((100.0, 100.0, 100.0))
    filled = vertices[faces].mean(axis=1)[:, 0] > 0
    (loop,) = loops_at(vertices, faces, 10.0, filled)
    assert loop.measured_share == pytest.approx(0.5, abs=0.01)


def test_a_plane_beside_the_body_cuts_nothing() -> None:
    assert loops_at(*ELLIPSOID, 251.0) == ()
    assert loops_at(*ELLIPSOID, -251.0) == ()


def test_ranges_of_heights_are_those_of_each_faces_corners() -> None:
    rng = np.random.default_rng(5)
    vertices, faces = rng.normal(size=(40, 3)), rng.integers(0, 40, (90, 3))
    low, high = height_ranges(vertices, faces)
    assert low.tolist() == [min(vertices[face, 2]) for face in faces]
    assert high.tolist() == [max(vertices[face, 2]) for face in faces]


def square(*measured: bool, regions: list[int] | None = None) -> Loop:
    """A square of 40 mm, anticlockwise in pieces of 10, each measured or not; their order is mixed."""
    corners = np.array([[0, 0], [40, 0], [40, 40], [0, 40], [0, 0]], float)
    points = np.concatenate([np.linspace(corners[k], corners[k + 1], 5)[:4] for k in range(4)])
    segments = np.stack([points, np.roll(points, -1, axis=0)], axis=1)
    ends = np.stack([np.arange(16), np.roll(np.arange(16), -1)], axis=1) + 100
    seen = np.array(measured or (True,) * 16)
    order = np.random.default_rng(1).permutation(16)
    known = None if regions is None else np.array(regions, np.uint8)[order]
    return Loop(segments[order], seen[order], ends[order], known)


def test_a_loop_is_cut_where_it_was_not_measured_for_long_enough() -> None:
    seen = np.ones(16, bool)
    seen[[2, 3, 9]] = False
    loop = square(*seen.tolist())
    runs = runs_of(loop, 15.0)  # the 10 mm of number 9 count as measured
    assert sorted(len(run.segments) for run in runs) == [2, 14]
    (gap,) = (run for run in runs if not run.measured)
    assert loop.segments[gap.first, 0].tolist() == [20.0, 0.0]
    assert loop.segments[gap.last, 1].tolist() == [40.0, 0.0]
    (rest,) = (run for run in runs if run.measured)
    assert loop.segments[rest.first, 0].tolist() == [40.0, 0.0]
    assert loop.segments[rest.last, 1].tolist() == [20.0, 0.0]
    assert len(runs_of(loop, 9.0)) == 4
    assert len(runs_of(loop, 25.0)) == 1
    one_after_another = runs_of(loop, 9.0)
    for run, following in zip(
        one_after_another, (*one_after_another[1:], one_after_another[0]), strict=True
    ):
        assert loop.ends[run.last, 1] == loop.ends[following.first, 0]


def test_stretches_are_joined_straight_and_what_is_new_was_not_measured() -> None:
    seen = np.ones(16, bool)
    seen[3:6] = False  # round one corner
    loop = square(*seen.tolist(), regions=[1] * 8 + [2] * 8)
    (kept,) = (run for run in runs_of(loop, 5.0) if run.measured)
    found = joined(loop, [kept])
    assert found.girth_mm == pytest.approx(130.0 + np.hypot(10.0, 20.0))
    assert found.area_mm2 == pytest.approx(1600.0 - 0.5 * 10.0 * 20.0)
    assert found.measured_share == pytest.approx(130.0 / found.girth_mm)
    shares = found.region_shares
    assert shares is not None
    assert list(shares.values()) == pytest.approx(
        [np.hypot(10.0, 20.0) / found.girth_mm, 50.0 / found.girth_mm, 80.0 / found.girth_mm]
        + [0.0] * (len(shares) - 3)
    )
    whole = joined(loop, runs_of(loop, 5.0))
    assert whole.girth_mm == pytest.approx(160.0)
    assert len(whole.segments) == 16


def test_of_a_square_all_figures_are_known() -> None:
    loop = square()
    assert (loop.girth_mm, loop.tape_mm) == pytest.approx((160.0, 160.0))
    assert loop.area_mm2 == pytest.approx(1600.0)
    np.testing.assert_allclose(loop.centre, [20.0, 20.0])
    assert (loop.measured_share, loop.region_shares) == (1.0, None)
    # A speck in one line has a hull as well: there and back.
    assert hull_mm(np.array([[0.0, 0.0], [3.0, 4.0], [1.5, 2.0]])) == pytest.approx(10.0)
