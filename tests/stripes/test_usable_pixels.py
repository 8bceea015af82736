"""What pixels are worth: beside their neighbours (jumps, rims, order), and in the scan volume."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from bodyscan.arrays import Array, Floats, Greys, Mask
from bodyscan.stripes.scan_lines import ScanLines
from bodyscan.stripes.stripe_limits import StripeLimits
from bodyscan.stripes.stripe_map import find_whole_numbers
from bodyscan.stripes.usable_pixels import (
    find_code_jumps,
    find_half_covered_pixels,
    find_min_contrast,
    find_usable_pixels,
)

NAN = np.float32(np.nan)


def test_pixels_beside_a_jump_of_more_than_one_are_marked_in_all_four_directions() -> None:
    codes = np.full((5, 7), 8, np.int32)
    codes[2, 3] = 10
    around = np.zeros(codes.shape, bool)
    for line, place in ((2, 3), (1, 3), (3, 3), (2, 2), (2, 4)):
        around[line, place] = True
    every = np.ones(codes.shape, bool)
    assert np.array_equal(find_code_jumps(codes, every), around)
    codes[2, 3] = 6
    assert np.array_equal(find_code_jumps(codes, every), around)
    codes[2, 3] = 9  # the next stripe is no jump
    assert not find_code_jumps(codes, every).any()
    codes[2, 3] = 10
    every[2, 3] = False  # nor is what cannot be used
    assert not find_code_jumps(codes, every).any()


def test_a_pixel_at_the_rim_that_is_much_darker_than_its_neighbour_is_half_covered() -> None:
    contrast = np.full((6, 8), 100, np.uint8)
    contrast[:, 5:] = 0
    contrast[:3, 4], contrast[3:, 4] = 69, 70  # 70 % of the brightest neighbour is the limit
    lit = contrast > 10
    found = find_half_covered_pixels(contrast, lit)
    assert found[:, 4].tolist() == [True, True, True, False, False, False]
    assert not found[:, 1:4].any()  # dark print inside is none
    contrast[2, 2] = 30
    assert not find_half_covered_pixels(contrast, lit)[2, 2]
    contrast[0, 0] = 30  # beyond the picture nothing is known to be dark
    assert not find_half_covered_pixels(contrast, lit)[0, 0]


def seen(lit: float, dark: float, of: type, *, code: int = 3, variance: float = 1.0) -> bool:
    """Whether a pixel is shown, one of a picture of such pixels under a single coarse pattern."""
    light: Greys = np.full((9, 9), lit).astype(of)
    black: Greys = np.full((9, 9), dark).astype(of)
    images = ScanLines(light, black, light[None], black[None], False)
    codes = np.full((9, 9), code, np.int32)
    levels = np.full(256, variance, np.float32)
    return bool(find_usable_pixels(images, codes, levels, 8, 0)[1][4, 4])


def test_usable_pixels_have_contrast_and_are_not_saturated() -> None:
    assert seen(105, 100, np.uint8)
    assert not seen(104, 100, np.uint8)  # noise of 1: five sigmas
    assert seen(104, 100, np.uint8, variance=0.1)  # four whole grey levels at least
    assert not seen(103, 100, np.uint8, variance=0.1)
    assert seen(100.6, 100.0, np.float32, variance=0.01)  # of finer ones, noise alone decides
    assert not seen(100.4, 100.0, np.float32, variance=0.01)
    assert seen(253, 100, np.uint8)
    assert not seen(254, 100, np.uint8)
    assert find_min_contrast(np.dtype(np.uint8)) == 4.0
    assert find_min_contrast(np.dtype(np.float32)) == 0.0


def test_codes_that_were_not_projected_are_unusable() -> None:
    assert [seen(200, 20, np.uint8, code=code) for code in (-1, 0, 7, 8)] == [
        False, True, True, False,
    ]  # fmt: skip


def test_s_passes_whole_numbers_where_a_line_between_pixels_does() -> None:
    s = np.array(
        [
            [0.2, 0.7, 1.2, 1.7, 2.2, 2.7],
            [2.7, 2.2, 1.7, 1.2, 0.7, 0.2],
            [0.5, 1.6, 3.2, 3.4, NAN, 4.6],  # the second step is too long, the last has a hole
            [1.0, 1.4, 2.0, 2.4, 2.9, 3.0],
        ],
        np.float32,
    )
    found = find_whole_numbers(s, np.full(s.shape, 0.1, np.float32), 0.4)
    assert found.line.tolist() == [0, 0, 1, 1, 2, 3, 3]
    assert found.index.tolist() == [1, 2, 2, 1, 1, 2, 3]
    np.testing.assert_allclose(found.position, [1.6, 3.6, 1.4, 3.4, 0.5 / 1.1, 2.0, 5.0], atol=1e-6)
    assert found.before.tolist() == [1, 3, 1, 3, 0, 1, 4]
    assert np.array_equal(found.line_position, found.line)
    assert found.joined.tolist() == [True, False, True, False, False, True]
    assert found.blur2 == 0.4


def test_sigma_of_a_boundary_follows_from_its_pixels() -> None:
    s = np.array([[0.0, 0.5, 1.5], [0.0, 0.75, 1.75]], np.float32)
    sigma = np.array([[9.0, 0.3, 0.4], [9.0, 0.3, 0.4]], np.float32)
    found = find_whole_numbers(s, sigma, 0.0)
    # Halfway, and a quarter of the way, between two pixels one stripe apart.
    np.testing.assert_allclose(
        found.sigma_px,
        [np.hypot(np.hypot(0.15, 0.2), 0.008), np.hypot(np.hypot(0.225, 0.1), 0.008)],
        rtol=1e-6,
    )
    gentle = find_whole_numbers(
        np.array([[0.9, 1.1]], np.float32), np.full((1, 2), 0.1, np.float32), 0
    )
    assert gentle.sigma_px[0] == pytest.approx(0.1 * np.sqrt(0.5) / 0.2, rel=1e-3)


def test_pixels_beside_a_jump_show_a_code_that_cannot_be_relied_on() -> None:
    light, black = np.full((5, 9), 200, np.uint8), np.full((5, 9), 20, np.uint8)
    images = ScanLines(light, black, light[None], black[None], False)
    codes = np.tile(np.array([3, 3, 3, 3, 3, 6, 6, 6, 6], np.int32), (5, 1))
    levels = np.ones(256, np.float32)
    usable, shown = find_usable_pixels(images, codes, levels, 8, 0)
    assert shown.all()
    assert usable.tolist() == [[True] * 4 + [False] * 2 + [True] * 3] * 5
    assert np.array_equal(find_usable_pixels(images, codes, levels, 8, 0)[0], usable)


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
