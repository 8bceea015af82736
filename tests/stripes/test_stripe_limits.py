"""Which pixels lie in the scan volume, by their stripes: limits laid out by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from bodyscan.arrays import Array, Floats, Mask
from bodyscan.stripes.stripe_limits import StripeLimits

BLOCK = 16
ROWS, COLUMNS = 2, 6  # blocks
SHAPE = (BLOCK * ROWS, BLOCK * COLUMNS)
EVERY = np.ones(SHAPE, bool)


def limits(
    near: Array | float, far: Array | float, standing: Array | float, **more: Any
) -> StripeLimits:
    """At the blocks' corners."""

    def everywhere(each: Array | float) -> Floats:
        return np.broadcast_to(each, (ROWS + 1, COLUMNS + 1)).astype(np.float32)

    rest: Any = {"rising": True, "block_px": BLOCK, "around_px": 8.0} | more
    return StripeLimits(everywhere(near), everywhere(far), everywhere(standing), **rest)


def along(values: list[float], kind: Any = np.float32) -> Any:
    """s of a picture whose columns show these, and the last of them beyond."""
    row = np.array([*values, *[values[-1]] * (SHAPE[1] - len(values))], kind)
    return np.tile(row, (SHAPE[0], 1))


def wanted(of: StripeLimits, s: Any, usable: Mask = EVERY) -> list[int]:
    """Columns that are wanted all over."""
    there, _ = of.split(s, usable)
    assert (there.all(axis=0) == there.any(axis=0)).all()
    return np.flatnonzero(there.all(axis=0)).tolist()


def test_what_lies_between_near_and_far_is_wanted() -> None:
    of = limits(10.0, 20.0, 1e6)
    assert wanted(of, along([9.99, 10.0, 15.0, 20.0, 20.01])) == [1, 2, 3]
    assert wanted(of, along([15.0, 15.0, 0.0]), EVERY & (np.arange(SHAPE[1]) != 1)) == [0]
    # Of a stripe its middle counts.
    assert wanted(of, along([8, 9, 10, 19, 20], np.int32)) == [2, 3]
    falling = limits(-20.0, -10.0, 1e6, rising=False)
    assert wanted(falling, along([9.99, 10.0, 20.0, 20.01])) == [1, 2]
    assert wanted(falling, along([8, 9, 10, 19, 20], np.int32)) == [2, 3]


def test_between_the_corners_of_blocks_limits_are_linear() -> None:
    across = np.arange(COLUMNS + 1.0) * BLOCK
    s = np.tile(np.arange(SHAPE[1]) + 0.5, (SHAPE[0], 1))
    for off, inside in ((0.01, True), (-0.01, False)):
        there, _ = limits(across, 1e6, 1e6).split((s + off).astype(np.float32), EVERY)
        assert there.all() if inside else not there.any()
    down = np.arange(ROWS + 1.0)[:, None] * BLOCK
    s = np.tile(np.arange(SHAPE[0])[:, None] + 0.5, (1, SHAPE[1]))
    for off, inside in ((-0.01, True), (0.01, False)):
        there, _ = limits(-1e6, down, 1e6).split((s + off).astype(np.float32), EVERY)
        assert there.all() if inside else not there.any()
        # Lines that are the image's columns.
        turned, _ = limits(-1e6, down, 1e6).split(
            (s + off).T.astype(np.float32), EVERY.T, transposed=True
        )
        np.testing.assert_array_equal(turned, there.T)


def test_the_lowest_layer_is_wanted_around_what_stands_higher() -> None:
    """Tiles of eight pixels: of a body in columns 32 to 39 the tile, and one on either side."""
    of = limits(10.0, 20.0, 18.0)
    s = np.full(SHAPE, 19.0, np.float32)
    s[:, 32:40] = 12.0
    there, deep = of.split(s, EVERY)
    kept = np.zeros(SHAPE[1], bool)
    kept[24:48] = True
    np.testing.assert_array_equal(there, np.tile(kept, (SHAPE[0], 1)))
    np.testing.assert_array_equal(deep, ~there)
    wide, _ = limits(10.0, 20.0, 18.0, around_px=8.1).split(s, EVERY)
    assert np.flatnonzero(wide[0]).tolist() == list(range(16, 56))
    # What lies beyond `far` is told as well; what is nearer than `near` is not.
    s[:, :8], s[:, 8:16] = 25.0, 5.0
    there, deep = of.split(s, EVERY)
    assert deep[:, :8].all()
    assert not deep[:, 8:16].any()
    assert not there[:, :16].any()


@pytest.mark.parametrize(("standing", "kept"), [(3, True), (4, False)])
def test_a_plate_may_lie_there_where_next_to_nothing_stands(standing: int, kept: bool) -> None:
    """Of 3072 pixels a thousandth are three."""
    s = np.full(SHAPE, 19.0, np.float32)
    s[0, :standing] = 12.0
    there, deep = limits(10.0, 20.0, 18.0).split(s, EVERY)
    assert there.all() == kept
    assert deep.any() != kept


def test_where_far_is_below_near_nothing_is_wanted_nor_beyond() -> None:
    there, deep = limits(20.0, 10.0, 5.0).split(np.full(SHAPE, 15.0, np.float32), EVERY)
    assert not there.any()
    assert not deep.any()
