"""What pixels are worth beside their neighbours: jumps, rims, whole numbers, the order of stripes."""

from __future__ import annotations

import numpy as np
import pytest

from bodyscan.arrays import Greys
from bodyscan.stripes.scan_lines import ScanLines
from bodyscan.stripes.stripe_map import find_whole_numbers
from bodyscan.stripes.usable_pixels import (
    find_code_jumps,
    find_half_covered_pixels,
    find_usable_pixels,
    min_contrast,
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
    assert min_contrast(np.dtype(np.uint8)) == 4.0
    assert min_contrast(np.dtype(np.float32)) == 0.0


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
