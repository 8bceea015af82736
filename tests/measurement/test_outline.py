"""Girths where nobody measured the skin: webs between limbs are cut, and the rest is a range."""

from __future__ import annotations

import numpy as np
import pytest

from bodyscan.arrays import Array, Mask
from bodyscan.measurement.outline import Outline, find_outline
from bodyscan.mesh.slices import Loop, MeshSlicer

TRUNK_MM, ARM_MM, ARM_AT_MM = 150.0, 45.0, 230.0


def arc(
    radius: float, centre: float, start_deg: float, end_deg: float, every_deg: float = 1.0
) -> Array:
    """Points (N, 2) about (0, centre), anticlockwise from x to y."""
    angle = np.radians(np.arange(start_deg, end_deg + 0.1, every_deg))
    return np.stack([radius * np.cos(angle), centre + radius * np.sin(angle)], axis=-1)


def wall(points: Array, filled: Mask) -> Loop:
    """The slice of an upright wall over a closed outline (N, 2); filled: (N,), from each point on."""
    count = len(points)
    foot = np.column_stack([points, np.zeros(count)])
    vertices = np.concatenate([foot, foot + [0.0, 0.0, 100.0]])
    here, after = np.arange(count), np.roll(np.arange(count), -1)
    faces = np.concatenate(
        [
            np.stack([here, after, after + count], 1),
            np.stack([here, after + count, here + count], 1),
        ]
    )
    (loop,) = MeshSlicer(vertices, faces, np.tile(filled, 2)).slice(50.0)
    return loop


def with_arms(sides: tuple[int, ...] = (1, -1)) -> Outline:
    """A round trunk of which 40 degrees on each side are hidden by an arm that webs join to it."""
    left = [arc(TRUNK_MM, 0.0, -70.0, 70.0)] if sides else []
    parts = [*left]
    if 1 in sides:
        parts.append(arc(ARM_MM, ARM_AT_MM, -40.0, 220.0))
    parts.append(arc(TRUNK_MM, 0.0, 110.0, 250.0))
    if -1 in sides:
        parts.append(arc(ARM_MM, -ARM_AT_MM, 140.0, 400.0))
    points = np.concatenate(parts)
    filled = np.zeros(len(points), bool)
    filled[np.cumsum([len(part) for part in parts]) - 1] = True
    return find_outline(wall(points, filled))


def test_a_trunk_is_cut_from_the_arms_that_filled_surface_joins_to_it() -> None:
    found = with_arms()
    hidden = np.radians(40.0)
    closed = TRUNK_MM * (2.0 * np.pi - 2.0 * hidden) + 4.0 * TRUNK_MM * np.sin(0.5 * hidden)
    assert found.loop.tape_mm == pytest.approx(closed, rel=1e-3)
    assert found.loop.girth_mm == pytest.approx(closed, rel=1e-3)
    whole = 2.0 * np.pi * TRUNK_MM
    assert found.tape_range_mm[0] < whole < found.tape_range_mm[1]
    assert found.tape_range_mm[1] > whole + 200.0  # as meshed, arms and all
    assert found.loop.measured_share == pytest.approx(1.0 - 4.0 * 51.3 / closed, abs=0.12)
    assert found.loop.area_mm2 == pytest.approx(np.pi * TRUNK_MM**2, rel=0.02)


def test_one_arm_is_cut_and_the_other_side_stays() -> None:
    found = with_arms((1,))
    ys = found.loop.segments[..., 1]
    assert ys.max() < TRUNK_MM + 1.0
    assert ys.min() == pytest.approx(-TRUNK_MM * np.sin(np.radians(70.0)), abs=1.0)


def test_a_strip_of_the_trunk_between_two_gaps_is_no_limb() -> None:
    """Its own side, seen between two shadows, goes round by far less than an arm."""
    points = arc(TRUNK_MM, 0.0, 0.0, 359.0)
    degrees = np.arange(len(points))
    filled = ((degrees > 40) & (degrees < 60)) | ((degrees > 120) & (degrees < 140))
    found = find_outline(wall(points, filled))
    assert found.loop.girth_mm == pytest.approx(2.0 * np.pi * TRUNK_MM, rel=1e-3)
    assert found.girth_range_mm[0] < found.loop.girth_mm - 0.2
    assert found.loop.measured_share == pytest.approx(1.0 - 38.0 / 360.0, abs=0.01)


def test_what_was_measured_all_round_has_no_range() -> None:
    points = arc(TRUNK_MM, 0.0, 0.0, 359.0)
    found = find_outline(wall(points, np.zeros(len(points), bool)))
    assert np.ptp(found.girth_range_mm) == pytest.approx(0.0, abs=1e-9)
    assert np.ptp(found.tape_range_mm) == pytest.approx(0.0, abs=1e-9)


def test_small_holes_do_not_count() -> None:
    """5 mm of 942 that nobody measured: a straight line across is as good."""
    points = arc(TRUNK_MM, 0.0, 0.0, 359.0)
    filled = np.isin(np.arange(len(points)), [10, 11, 200])
    assert np.ptp(find_outline(wall(points, filled)).girth_range_mm) == pytest.approx(0.0, abs=1e-9)


def test_a_limb_that_is_seen_in_part_lies_between_chord_and_fill() -> None:
    points = arc(60.0, 100.0, 0.0, 359.0)
    degrees = np.arange(len(points))
    found = find_outline(wall(points, (degrees > 200) & (degrees < 280)))
    chord = 60.0 * (2.0 * np.pi - np.radians(79.0)) + 120.0 * np.sin(np.radians(39.5))
    assert found.girth_range_mm == pytest.approx((chord, 2.0 * np.pi * 60.0), rel=2e-3)


@pytest.mark.parametrize("segments", [None, 3])
@pytest.mark.parametrize(("half_deg", "limb"), [(85.0, False), (95.0, True)])
def test_a_limb_goes_round_by_more_than_half(
    half_deg: float, limb: bool, segments: int | None
) -> None:
    """A round piece beside the trunk, of which so much on either side of its outermost was seen;
    however coarse the mesh, from where its first segment begins to where its last one ends."""
    turned = np.radians(half_deg)
    every = 1.0 if segments is None else 2.0 * half_deg / segments
    half_deg += 0.0 if segments is None else 5.0 if limb else 0.0
    arm = arc(ARM_MM, ARM_AT_MM, 90.0 - half_deg, 90.0 + half_deg, every)
    points = np.concatenate(
        [arc(TRUNK_MM, 0.0, -70.0, 70.0), arm, arc(TRUNK_MM, 0.0, 110.0, 290.0)]
    )
    filled = np.zeros(len(points), bool)
    ends = np.cumsum([141, len(arm)]) - 1
    filled[ends] = True
    found = find_outline(wall(points, filled))
    assert (found.loop.segments[..., 1].max() < ARM_AT_MM) == limb
    assert np.sin(turned) / turned < 0.68  # chord over arc, 0.64 of half a circle


def test_a_strip_across_the_front_is_no_trunk_with_the_rest_for_a_limb() -> None:
    """Both hold the middle, and the rest goes round by far more than half."""
    points = arc(TRUNK_MM, 0.0, -180.0, 179.0)
    degrees = np.arange(len(points)) - 180
    found = find_outline(wall(points, (abs(degrees) > 30) & (abs(degrees) < 50)))
    assert found.loop.girth_mm == pytest.approx(2.0 * np.pi * TRUNK_MM, rel=1e-3)


def test_of_two_legs_that_filled_surface_joins_neither_is_the_trunk() -> None:
    """Each lies on its side of the middle and goes round by more than half."""
    legs = [arc(70.0, 100.0, -60.0, 240.0), arc(70.0, -100.0, 120.0, 420.0)]
    points = np.concatenate(legs)
    filled = np.isin(np.arange(len(points)), [len(legs[0]) - 1, len(points) - 1])
    whole = wall(points, filled)
    assert find_outline(whole).loop.girth_mm == pytest.approx(whole.girth_mm)
