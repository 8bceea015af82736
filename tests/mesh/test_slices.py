"""Slices of bodies whose girths are known from formulas."""

from __future__ import annotations

import numpy as np
import open3d as o3d
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_bodies import arrays, cylinder, ellipsoid, together
from scipy.special import ellipe

from bodyscan.mesh.slices import Loop, MeshSlicer, compute_hull_perimeter, keep_segments, split_runs


@pytest.mark.parametrize("height", [55.0, 100.0, 123.4])  # 100 lies on a ring of vertices
def test_a_cylinder_is_cut_in_a_circle(height: float) -> None:
    (loop,) = MeshSlicer(*cylinder(80.0, 0.0, 200.0)).slice(height)
    # 400 corners on a circle: shorter by pi^2 / (6 * 400^2), a hundred-thousandth.
    assert loop.girth_mm == pytest.approx(2 * np.pi * 80.0, rel=2e-5)
    assert loop.tape_mm == pytest.approx(2 * np.pi * 80.0, rel=2e-5)
    assert loop.area_mm2 == pytest.approx(np.pi * 80.0**2, rel=5e-5)
    assert loop.centre == pytest.approx([0.0, 0.0], abs=1e-6)


@given(share=st.floats(-0.9, 0.9))
def test_an_ellipsoid_is_cut_in_an_ellipse(share: float) -> None:
    (loop,) = MeshSlicer(*ELLIPSOID).slice(250.0 * share)
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
    outer, inner = MeshSlicer(vertices, faces).slice(0.0)
    assert outer.girth_mm == pytest.approx(2 * np.pi * 130.0, rel=1e-3)
    assert inner.girth_mm == pytest.approx(2 * np.pi * 70.0, rel=1e-3)
    assert outer.area_mm2 + inner.area_mm2 == pytest.approx(np.pi * (130.0**2 - 70.0**2), rel=2e-3)
    upright = vertices[:, [2, 0, 1]]
    one, other = MeshSlicer(upright, faces).slice(0.0)
    for loop in (one, other):
        assert loop.girth_mm == pytest.approx(2 * np.pi * 30.0, rel=2e-3)
    assert sorted([one.centre[1], other.centre[1]]) == pytest.approx([-100.0, 100.0], abs=0.1)
    # Just above the hole's edge the two have run together, with a waist between them.
    (both,) = MeshSlicer(upright, faces).slice(75.0)
    assert both.tape_mm < both.girth_mm - 5.0
    assert both.area_mm2 > 0


def test_each_leg_is_a_loop() -> None:
    legs = together(cylinder(70.0, 0.0, 700.0, y=90.0), cylinder(60.0, 0.0, 700.0, y=-90.0))
    left, right = MeshSlicer(*legs).slice(333.0)
    assert left.girth_mm == pytest.approx(2 * np.pi * 70.0, rel=2e-5)
    assert right.girth_mm == pytest.approx(2 * np.pi * 60.0, rel=2e-5)
    assert left.centre[1] == pytest.approx(90.0)


def test_the_measured_share_excludes_filled_faces() -> None:
    vertices, faces = ellipsoid((100.0, 100.0, 100.0))
    filled = vertices[faces].mean(axis=1)[:, 0] > 0
    (loop,) = MeshSlicer(vertices, faces, filled).slice(10.0)
    assert loop.measured_share == pytest.approx(0.5, abs=0.01)


def test_a_plane_outside_the_body_cuts_nothing() -> None:
    assert MeshSlicer(*ELLIPSOID).slice(251.0) == ()
    assert MeshSlicer(*ELLIPSOID).slice(-251.0) == ()


def square(*measured: bool) -> Loop:
    """A square of 40 mm, anticlockwise in pieces of 10, each measured or not."""
    corners = np.array([[0, 0], [40, 0], [40, 40], [0, 40], [0, 0]], float)
    points = np.concatenate([np.linspace(corners[k], corners[k + 1], 5)[:4] for k in range(4)])
    segments = np.stack([points, np.roll(points, -1, axis=0)], axis=1)
    return Loop(segments, np.array(measured or (True,) * 16), np.arange(16))


def test_segments_follow_each_other() -> None:
    for loop in MeshSlicer(*ELLIPSOID).slice(30.0):
        np.testing.assert_array_equal(loop.segments[:, 1], np.roll(loop.segments[:, 0], -1, axis=0))


def test_a_loop_is_split_at_long_unmeasured_gaps() -> None:
    measured = np.ones(16, bool)
    measured[[2, 3, 9]] = False
    loop = square(*measured.tolist())
    seen, runs = split_runs(loop, 15.0)  # the 10 mm of number 9 count as measured
    (gap,) = (run for run, known in zip(runs, seen, strict=True) if not known)
    assert gap.tolist() == [2, 3]
    (rest,) = (run for run, known in zip(runs, seen, strict=True) if known)
    assert rest.tolist() == [*range(4, 16), 0, 1]
    assert len(split_runs(loop, 9.0)[1]) == 4
    assert len(split_runs(loop, 25.0)[1]) == 1


def test_what_is_kept_of_a_loop_is_closed_by_straight_unmeasured_segments() -> None:
    kept = np.ones(16, bool)
    kept[3:6] = False  # round one corner
    found = keep_segments(square(), kept)
    assert found.girth_mm == pytest.approx(130.0 + np.hypot(10.0, 20.0))
    assert found.area_mm2 == pytest.approx(1600.0 - 0.5 * 10.0 * 20.0)
    assert found.measured_share == pytest.approx(130.0 / found.girth_mm)
    assert found.faces.tolist() == [0, 1, 2, -1, *range(6, 16)]
    whole = keep_segments(square(), np.ones(16, bool))
    assert whole.girth_mm == pytest.approx(160.0)
    assert len(whole.segments) == 16


def test_figures_of_a_square() -> None:
    loop = square()
    assert (loop.girth_mm, loop.tape_mm) == pytest.approx((160.0, 160.0))
    assert loop.area_mm2 == pytest.approx(1600.0)
    np.testing.assert_allclose(loop.centre, [20.0, 20.0])
    assert loop.measured_share == 1.0
    # A speck in one line has a hull as well: there and back.
    assert compute_hull_perimeter(np.array([[0.0, 0.0], [3.0, 4.0], [1.5, 2.0]])) == pytest.approx(
        10.0
    )
