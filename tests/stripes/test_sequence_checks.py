"""Checks of exposure, direction and order of the frames of a bit sequence (sharp synthetic frames)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from bodyscan.arrays import Bytes, Indices, Mask
from bodyscan.errors import DecodingFailed, WrongDirection
from bodyscan.stripes.gray.bit_words import BINARY, GRAY, WordCode
from bodyscan.stripes.gray.sequence_checks import check_exposure, check_words, measure_nonlinearity
from bodyscan.stripes.scan_lines import ScanLines
from bodyscan.stripes.usable_pixels import check_direction, check_illumination

BITS = 6


def first_pixels(share: float) -> Mask:
    """A mask of the first pixels of an image, so large a share of it."""
    return np.asarray(np.arange(10_000) < share * 10_000).reshape(100, 100)


def exposed(lit: Bytes, dark: Bytes | int = 20, patterns: Sequence[Bytes] = ()) -> None:
    """Check the exposure: of lit and dark alone without patterns, which then have inverses."""
    dark = np.broadcast_to(np.uint8(dark), lit.shape) if isinstance(dark, int) else dark
    coded = np.array(patterns, np.uint8) if patterns else np.empty((0, *lit.shape), np.uint8)
    inverses = None if patterns else coded
    check_exposure(ScanLines(lit.astype(np.uint8), dark, coded, inverses, transposed=False))


def test_a_projector_that_lights_next_to_nothing_or_too_much_is_refused() -> None:
    lit = np.full((100, 100), 200)
    check_illumination(first_pixels(0.001), lit)
    with pytest.raises(DecodingFailed, match=r"lights only 0\.09% of the image"):
        check_illumination(first_pixels(0.0009), lit)
    saturated = np.where(first_pixels(0.31), 255, 200)
    with pytest.raises(DecodingFailed, match="52% of the lit pixels are saturated"):
        check_illumination(first_pixels(0.6), saturated)
    check_illumination(first_pixels(0.9), saturated)
    exposed(np.full((100, 100), 24))
    with pytest.raises(DecodingFailed, match="lights only"):
        exposed(np.full((100, 100), 23))


def test_a_dark_frame_brighter_than_the_lit_one_was_exchanged_with_it() -> None:
    exposed(np.where(first_pixels(0.49), 20, 60), 40)
    exposed(np.where(first_pixels(0.51), 37, 60), 40)  # by three levels: noise
    with pytest.raises(DecodingFailed, match="the dark frame is brighter"):
        exposed(np.where(first_pixels(0.51), 36, 60), 40)


@pytest.mark.parametrize(("side", "level"), [(1, 120), (-1, 20)])
def test_without_inverses_a_pattern_lies_between_dark_and_lit(side: int, level: int) -> None:
    """Four grey levels beyond them are noise, and 15 % of their contrast besides."""
    lit = np.full((100, 100), 120)
    middle, beyond = np.full_like(lit, 70), np.full_like(lit, level + side * 18)
    exposed(lit, 20, [middle, beyond])
    with pytest.raises(DecodingFailed, match=r"bit 1 is brighter .* \(by 16% of their"):
        exposed(lit, 20, [middle, beyond + side * 2])
    striped = np.where(np.arange(100) % 20 < 10, lit, 20)
    exposed(lit, 20, [np.where(striped == level, level + side * 12, striped)])  # flicker
    with pytest.raises(DecodingFailed, match="bit 0 is brighter"):
        exposed(lit, 20, [striped + side * 12])


@pytest.mark.parametrize("transposed", [False, True])
def test_stripes_that_change_more_often_from_line_to_line_run_the_other_way(
    transposed: bool,
) -> None:
    good = np.ones((10, 10), bool)
    x = np.arange(10)
    numbers = np.minimum(x, 2) + 20 * np.minimum(x, 5)[:, None]
    check_direction(numbers - 20 * (x[:, None] >= 5), good, transposed)
    actual, given = ("vertical", "horizontal") if transposed else ("horizontal", "vertical")
    with pytest.raises(WrongDirection, match=f"run {actual}ly in the image, not {given}ly"):
        check_direction(numbers, good, transposed)
    good[1::2] = False  # no two neighbouring lines are known
    check_direction(numbers, good, transposed)


def sharp_frames(words: Indices, *, inverses: bool) -> ScanLines:
    bit = words >> np.arange(BITS - 1, -1, -1)[:, None, None] & 1
    patterns = (20 + 100 * bit).astype(np.uint8)
    lit = np.full(words.shape, 120, np.uint8)
    other = 140 - patterns if inverses else None
    return ScanLines(lit, np.full_like(lit, 20), patterns, other, transposed=False)


def check(words: Indices, code: WordCode, *, inverses: bool = True, stripes: int = 64) -> None:
    variance = np.full(256, 0.5, np.float32)
    images = sharp_frames(words, inverses=inverses)
    check_words(images, words.astype(np.uint16), code, stripes, variance)


UP = np.tile(np.arange(64).repeat(5), (60, 1))


def encoded(stripe: Indices, code: WordCode = GRAY) -> Indices:
    return np.asarray(code.encode(stripe))


@pytest.mark.parametrize("inverses", [False, True])
@pytest.mark.parametrize("code", [GRAY, BINARY])
def test_a_twentieth_of_the_codes_may_lie_beyond_the_last_stripe(
    code: WordCode, inverses: bool
) -> None:
    check(encoded(UP, code), code, stripes=61, inverses=inverses)
    with pytest.raises(DecodingFailed, match="6% of the codes lie beyond the last stripe"):
        check(encoded(UP, code), code, stripes=60, inverses=inverses)


def exchange(words: Indices, first: int, second: int) -> Indices:
    """Exchange two bits, 0 the coarsest."""
    one, other = (1 << (BITS - 1 - bit) for bit in (first, second))
    rest = words & ~(one | other)
    return np.asarray(rest | (words & one > 0) * other | (words & other > 0) * one)


@pytest.mark.parametrize("inverses", [False, True])
@pytest.mark.parametrize("code", [GRAY, BINARY])
@pytest.mark.parametrize("bits", [(0, 1), (0, 5), (1, 3), (3, 4)])
def test_exchanged_bits_are_refused_with_the_measured_disagreement(
    code: WordCode, inverses: bool, bits: tuple[int, int]
) -> None:
    message = r"missing or out of order \(where bit \d changes, only \d+% of neighbouring pixels"
    with pytest.raises(DecodingFailed, match=message):
        check(exchange(encoded(UP, code), *bits), code, inverses=inverses)


def test_light_that_varies_between_frames_spoils_some_changes_only() -> None:
    """In a third of the lines, another stripe follows where bit 2 flips: a rim, not a wrong frame."""
    words = encoded(UP)
    rims = np.where(np.arange(60)[:, None] % 3 == 0, words, encoded(UP))
    rims[::3, 40:45] = encoded(np.array(4))
    check(rims, GRAY)


@pytest.mark.parametrize("code", [GRAY, BINARY])
@pytest.mark.parametrize(("down", "wrong"), [(8, False), (24, True)])
def test_stripes_count_one_way_along_the_lines(code: WordCode, down: int, wrong: bool) -> None:
    stripe = np.tile(np.arange(64).repeat(5), (100, 1))
    stripe[:down] = stripe[:down, ::-1]
    if wrong:
        with pytest.raises(DecodingFailed, match="of the pixels count stripes the other way"):
            check(encoded(stripe, code), code, inverses=False)
    else:
        check(encoded(stripe, code), code, inverses=False)


def frame_pairs(**strength: float) -> tuple[np.ndarray, np.ndarray]:
    """Float frames and inverses of Gray code; strength: contrast of a bit (`b5=0.2`)."""
    bit = encoded(UP) >> np.arange(BITS - 1, -1, -1)[:, None, None] & 1
    share = np.array([strength.get(f"b{k}", 1.0) for k in range(BITS)])[:, None, None]
    half = 100.0 * share * (bit - 0.5)
    return (70.0 + half).astype(np.float32), (70.0 - half).astype(np.float32)


def check_pairs(patterns: np.ndarray, inverses: np.ndarray) -> None:
    lit = np.full(UP.shape, 120.0, np.float32)
    images = ScanLines(lit, np.full_like(lit, 20.0), patterns, inverses, transposed=False)
    check_words(images, images.words(), GRAY, 64, np.full(256, 0.5, np.float32))


def test_the_finest_bits_may_be_blurred_to_an_even_grey() -> None:
    patterns, inverses = frame_pairs(b5=0.0)
    patterns[5] += np.random.default_rng(0).normal(0.0, 0.5, UP.shape).astype(np.float32)
    check_pairs(patterns, inverses)
    patterns, inverses = frame_pairs(b2=0.0, b3=0.0, b4=0.0, b5=0.0)
    with pytest.raises(DecodingFailed, match="bit 2 look alike"):
        check_pairs(patterns, inverses)


@pytest.mark.parametrize("level", [120.0, 20.0])
def test_a_finest_pattern_that_never_changes_is_refused(level: float) -> None:
    patterns, inverses = frame_pairs()
    patterns[5], inverses[5] = level, 140.0 - level
    with pytest.raises(DecodingFailed, match="only 0% of neighbouring pixels"):
        check_pairs(patterns, inverses)


@pytest.mark.parametrize("gamma", [1.0, 2.2])
def test_half_of_the_light_is_brighter_than_half_after_a_video_gamma(gamma: float) -> None:
    light = np.broadcast_to(np.clip((np.arange(200) % 40 - 12.0) / 16.0, 0.0, 1.0), (100, 200))
    as_stored = [(230.0 * x ** (1.0 / gamma)).astype(np.uint8) for x in (light, 1.0 - light)]
    lit, dark = np.full((100, 200), 230, np.uint8), np.zeros((100, 200), np.uint8)
    images = ScanLines(lit, dark, as_stored[0][None], as_stored[1][None], transposed=False)
    expected = 2.0 * 0.5 ** (1.0 / gamma) - 1.0
    assert measure_nonlinearity(images) == pytest.approx(expected, abs=0.02)  # a tenth beside equal
