"""Girths where nobody measured the skin, or skin touches skin, are ranges that hold the truth."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import ellipe

from bodyscan.arrays import Array, Mask
from bodyscan.measurement.outline import bound_girths, compute_girth_sigma
from bodyscan.mesh.slices import Loop

RADIUS_MM = 150.0


def closed(points: Array, measured: Mask) -> Loop:
    return Loop(
        np.stack([points, np.roll(points, -1, axis=0)], axis=1), measured, np.arange(len(points))
    )


def ranges(loop: Loop) -> list[tuple[float, float]]:
    """Of the girth and of the tape."""
    return list(zip(*bound_girths(loop), strict=True))


def ellipse(deep: float, wide: float) -> Array:
    """Points (360, 2), anticlockwise."""
    angle = np.radians(np.arange(360.0))
    return np.stack([deep * np.cos(angle), wide * np.sin(angle)], axis=-1)


def test_what_was_measured_all_round_is_known() -> None:
    loop = closed(ellipse(RADIUS_MM, RADIUS_MM), np.ones(360, bool))
    for low, high in ranges(loop):
        assert low == high == pytest.approx(2.0 * np.pi * RADIUS_MM, rel=1e-3)


def test_small_holes_do_not_count() -> None:
    """5 mm of 942: a straight line across is as good."""
    loop = closed(ellipse(RADIUS_MM, RADIUS_MM), ~np.isin(np.arange(360), [10, 11, 200]))
    assert np.ptp(ranges(loop), axis=1).max() == pytest.approx(0.0, abs=1e-9)


@given(
    wide=st.floats(100.0, 220.0),
    start=st.integers(0, 359),
    gap=st.integers(10, 150),
    pit=st.booleans(),
)
def test_a_range_holds_the_truth_however_a_hole_was_filled(
    wide: float, start: int, gap: int, pit: bool
) -> None:
    """Of trunks of any shape, with a hole of up to 40 %; a pit as deep as half the radius."""
    true = ellipse(120.0, wide)
    filled = np.mod(np.arange(360) - start, 360) < gap
    points = np.where(filled[:, None] & pit, 0.5 * true, true)
    girth = 4.0 * max(120.0, wide) * ellipe(1.0 - (min(120.0, wide) / max(120.0, wide)) ** 2)
    for low, high in ranges(closed(points, ~(filled | np.roll(filled, -1)))):
        assert low - 0.5 < girth < high + 0.5


def test_a_small_hole_leaves_little_open() -> None:
    filled = np.arange(360) < 20
    _, (low, high) = ranges(closed(ellipse(RADIUS_MM, RADIUS_MM), ~filled))
    assert 0.2 < high - low < 1.5


def test_what_nobody_measured_is_not_known() -> None:
    loop = closed(ellipse(RADIUS_MM, RADIUS_MM), np.zeros(360, bool))
    for low, high in ranges(loop):
        assert low == 0.0
        assert high > 1.5 * loop.girth_mm


@pytest.mark.parametrize(("sectors", "factor"), [(1, 2.0 * np.pi), (4, np.pi)])
def test_a_girth_is_as_uncertain_as_sectors_it_runs_through(sectors: int, factor: float) -> None:
    """By 2 pi times the common displacement of a surface all round, and by half if four are by
    themselves; whatever the shape."""
    loop = closed(ellipse(90.0, RADIUS_MM), np.ones(360, bool))
    assert compute_girth_sigma(loop, np.full(360, 0.3), sectors=sectors) == pytest.approx(
        0.3 * factor, rel=0.01
    )
    unknown = np.where(np.arange(360) < 20, np.nan, 0.3)
    assert compute_girth_sigma(loop, unknown, sectors=sectors) == pytest.approx(
        0.3 * factor, rel=0.01
    )
