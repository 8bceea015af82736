"""Changes of one bit along a scan line, in which noise has no part: which are taken, which are not."""

from __future__ import annotations

import numpy as np
import pytest

from bodyscan.arrays import Array, Bytes, Indices
from bodyscan.stripes.clear_changes import _is_rim, clear_changes
from bodyscan.stripes.scan_lines import ScanLines

BITS = 6
VARIANCE = 0.5  # of a grey level: pattern less inverse is clear from 4 on


def frames(words: Indices, lit: Bytes | None = None, step: Indices | int = 100) -> ScanLines:
    """Of code words (L, P); step: pattern less inverse, (bits, L, P) or of all."""
    bit = words >> np.arange(BITS - 1, -1, -1)[:, None, None] & 1
    half = (2 * bit - 1) * (np.broadcast_to(step, bit.shape) // 2)
    patterns, inverses = (70 + half).astype(np.uint8), (70 - half).astype(np.uint8)
    # Of an odd step the pattern has the odd one.
    patterns = np.where(bit > 0, patterns + np.broadcast_to(step, bit.shape) % 2, patterns)
    lit = np.full(words.shape, 120, np.uint8) if lit is None else lit
    return ScanLines(lit, np.full_like(lit, 20), patterns.astype(np.uint8), inverses, False)


def changes(
    words: Indices, lit: Bytes | None = None, step: Indices | int = 100, good: Array | None = None
) -> list[tuple[int, int, int]]:
    """Word, next word and mask of what is left out, of each change taken."""
    found = clear_changes(
        frames(words, lit, step),
        words.astype(np.uint16),
        np.ones(words.shape, bool) if good is None else good > 0,
        np.full(256, VARIANCE, np.float32),
    )
    return [(int(a), int(b), int(left_out)) for a, b, left_out in zip(*found, strict=True)]


def flip(at: int, place: int = 9, width: int = 20) -> Indices:
    """One line on which one bit (0 the finest) turns on behind `place`."""
    return np.where(np.arange(width) > place, 1 << at, 0)[None]


def test_every_clear_change_but_the_finest_bits_is_taken_once() -> None:
    stripe = np.tile(np.arange(64).repeat(5), (3, 1))
    gray = stripe ^ (stripe >> 1)
    ends = [i for i in range(1, 64) if i % 2 == 0]  # at the others the finest bit flips
    truth = [((i - 1) ^ ((i - 1) >> 1), i ^ (i >> 1), 0) for i in ends]
    assert sorted(changes(gray)) == sorted(3 * truth)


def test_neighbours_that_differ_in_more_than_one_bit_tell_nothing() -> None:
    assert changes(flip(1)) == [(0, 2, 0)]
    assert changes(3 * flip(1)) == []
    assert changes(0 * flip(1)) == []


def test_a_change_on_the_last_two_pixels_of_a_line_counts_and_none_at_a_bad_pixel() -> None:
    assert changes(flip(2, place=18)) == [(0, 4, 0)]
    assert changes(flip(2, place=0)) == [(0, 4, 0)]
    for bad in (9, 10):
        good = np.ones((1, 20))
        good[0, bad] = 0.0
        assert changes(flip(2), good=good) == []


@pytest.mark.parametrize("pixel", [9, 10])
@pytest.mark.parametrize("weak", [0, 1, 2, 4, 5])
def test_bits_that_noise_may_have_turned_are_left_out_with_those_finer(
    weak: int, pixel: int
) -> None:
    """Bit 3 flips: below it but one, a weak bit is left out; of any other the change is not taken."""
    for size, clear in ((3, False), (4, True)):
        step = np.full((BITS, 1, 20), 100)
        step[BITS - 1 - weak, 0, pixel] = size
        expected = [(0, 8, 0 if clear else (1 << weak + 1) - 1)]
        assert changes(flip(3), step=step) == (expected if clear or weak < 2 else [])


def test_the_bit_that_flips_need_not_be_clear_where_it_does() -> None:
    step = np.full((BITS, 1, 20), 100)
    step[BITS - 1 - 3, 0, 9:11] = 1
    assert changes(flip(3), step=step) == [(0, 8, 0)]


@pytest.mark.parametrize(("from_place", "taken"), [(6, False), (5, True), (14, False), (15, True)])
def test_a_change_at_a_rim_of_light_is_left_out(from_place: int, taken: bool) -> None:
    """Four pixels to either side one is more than twice as bright as the other; farther off it may."""
    beyond = np.arange(20) < from_place if from_place < 10 else np.arange(20) >= from_place
    for contrast in (20, 210):
        lit = np.where(beyond, 20 + contrast, 20 + 70).astype(np.uint8)[None]
        assert bool(changes(flip(2), lit=lit)) == taken


@pytest.mark.parametrize(("contrast", "taken"), [(95, True), (100, True), (105, False)])
def test_twice_the_light_makes_a_rim(contrast: int, taken: bool) -> None:
    right = np.arange(20) > 9
    for bright in (right, ~right):
        lit = np.where(bright, 20 + contrast, 20 + 50).astype(np.uint8)[None]
        assert bool(changes(flip(2), lit=lit)) == taken
    # Of lines that end before, their ends count.
    lit = np.where(np.arange(20) > 18, 20 + contrast, 20 + 50).astype(np.uint8)[None]
    assert bool(changes(flip(2, place=17), lit=lit)) == taken
    assert bool(changes(flip(2, place=1), lit=lit[:, ::-1])) == taken


@pytest.mark.parametrize("at", [3, 5])
def test_a_coarse_bit_has_to_stay_what_it_is_four_pixels_to_either_side(at: int) -> None:
    for back, taken in ((14, False), (15, True)):
        there = np.where(np.arange(20) < back, flip(at), 0)
        assert ((0, 1 << at, 0) in changes(there)) == taken
        assert ((1 << at, 0, 0) in changes(there[:, ::-1])) == taken
    begins = np.where(np.arange(20) < 16, flip(at, place=3), 0)
    assert (0, 1 << at, 0) not in changes(begins)  # the line begins too near
    assert changes(flip(at, place=4)) == [(0, 1 << at, 0)]
    assert changes(flip(at, place=14)) == [(0, 1 << at, 0)]
    assert changes(flip(at, place=15)) == []


def test_a_fine_bit_may_flip_back_at_once() -> None:
    there = np.where(np.arange(20) < 12, flip(2), 0)
    assert changes(there) == [(0, 4, 0), (4, 0, 0)]


@pytest.mark.parametrize("pixel", [5, 14])
def test_a_coarse_bit_has_to_be_clear_four_pixels_to_either_side(pixel: int) -> None:
    for size, taken in ((3, False), (4, True)):
        step = np.full((BITS, 1, 20), 100)
        step[BITS - 1 - 3, 0, pixel] = size
        assert bool(changes(flip(3), step=step)) == taken


@pytest.mark.parametrize(("bright", "place", "rim"), [
    ({19: 201}, 16, True), ({19: 200}, 16, False), ({0: 201}, 2, True), ({0: 200}, 2, False),
    # Four pixels beside the two.
    ({14: 201}, 9, True), ({13: 201, 15: 201}, 9, False), ({5: 201}, 9, True), ({5: 49}, 9, True),
    ({5: 50}, 9, False),
])  # fmt: skip
def test_brightness_is_compared_four_pixels_off_or_at_the_pictures_ends(
    bright: dict[int, int], place: int, rim: bool
) -> None:
    line = np.full(20, 100, np.uint8)
    line[list(bright)] = list(bright.values())
    assert _is_rim(line, place) is rim
