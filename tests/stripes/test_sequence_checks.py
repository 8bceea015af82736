"""From how much on a stripe sequence does not add up: each limit from both sides."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from bodyscan.arrays import Bytes, Indices, Mask
from bodyscan.errors import DecodingFailed, WrongDirection
from bodyscan.stripes.bit_words import BINARY, GRAY, WordCode
from bodyscan.stripes.scan_lines import ScanLines
from bodyscan.stripes.sequence_checks import (
    check_codes,
    check_direction,
    check_exposure,
    check_illumination,
)

BITS = 6


def some(share: float, shape: tuple[int, int] = (100, 100)) -> Mask:
    """The first pixels of a picture, so large a share of it."""
    return np.asarray(np.arange(shape[0] * shape[1]) < share * shape[0] * shape[1]).reshape(shape)


def frames(lit: Bytes, dark: Bytes | int = 20, patterns: Sequence[Bytes] = ()) -> ScanLines:
    dark = np.broadcast_to(np.uint8(dark), lit.shape) if isinstance(dark, int) else dark
    coded = np.array(patterns, np.uint8) if patterns else np.empty((0, *lit.shape), np.uint8)
    return ScanLines(lit.astype(np.uint8), dark, coded, None, turned=False)


def exposed(images: ScanLines) -> None:
    """Exposure alone is asked for: of frames that bear no pattern."""
    check_exposure(ScanLines(images.lit, images.dark, images.patterns, images.patterns, False))


def test_one_pixel_in_a_thousand_has_to_be_lit() -> None:
    lit = np.full((100, 100), 200)
    check_illumination(some(0.001), lit)
    with pytest.raises(DecodingFailed, match=r"lights only 0\.09% of the picture"):
        check_illumination(some(0.0009), lit)


def test_half_of_what_is_lit_may_be_saturated() -> None:
    for share, wrong in ((0.3, False), (0.31, True)):
        lit = np.where(some(share), 255, 200)
        lit[~some(0.6)] = 255  # not lit by the projector
        if wrong:
            with pytest.raises(DecodingFailed, match="52% of the lit pixels are saturated"):
                check_illumination(some(0.6), lit)
        else:
            check_illumination(some(0.6), lit)


def test_four_grey_levels_are_light() -> None:
    exposed(frames(np.full((100, 100), 24)))
    with pytest.raises(DecodingFailed, match="lights only"):
        exposed(frames(np.full((100, 100), 23)))


def test_a_dark_frame_brighter_than_the_lit_one_was_exchanged_with_it() -> None:
    dimmer, brighter = some(0.49), some(0.51)
    exposed(frames(np.where(dimmer, 20, 60), 40))
    exposed(frames(np.where(brighter, 37, 60), 40))  # by three levels: noise
    for image in (np.where(brighter, 36, 60), np.where(some(0.002), 20, 40)):
        with pytest.raises(DecodingFailed, match="the dark frame is brighter"):
            exposed(frames(image, 40))
    with pytest.raises(DecodingFailed, match="lights only"):  # too few to tell
        exposed(frames(np.where(some(0.0005), 20, 40), 40))


@pytest.mark.parametrize(("side", "level"), [(1, 120), (-1, 20)])
def test_a_pattern_may_leave_lit_and_dark_by_noise_and_a_seventh_of_their_contrast(
    side: int, level: int
) -> None:
    lit = np.full((100, 100), 120)
    for excess, wrong in ((18, False), (19, True)):  # four levels are noise: 14.5 and 15.5 %
        beyond = np.where(some(0.5), excess, excess + 1)
        image = frames(lit, 20, [np.full_like(lit, 70), level + side * beyond])
        if wrong:
            with pytest.raises(DecodingFailed, match=r"bit 1 is brighter .* \(by 16% of their"):
                check_exposure(image)
        else:
            check_exposure(image)


def test_what_leaves_lit_and_dark_counts_as_its_share_of_the_bright_pixels() -> None:
    """However far beyond a pixel is, and in a picture so large that only some pixels are looked at;
    dim and saturated ones do not count."""
    lit = np.full((340, 400), 120)
    lit[:, 300:350], lit[:, 350:] = 60, 255
    for columns, wrong in ((42, False), (48, True)):  # of the 300 that count: 14 and 16 %
        pattern = np.full_like(lit, 70)
        pattern[:, :columns] = 250
        pattern[:, 300:350] = 250
        pattern[:, 350:] = 0
        if wrong:
            with pytest.raises(DecodingFailed, match="bit 0 is brighter"):
                check_exposure(frames(lit, 20, [pattern]))
        else:
            check_exposure(frames(lit, 20, [pattern]))


@pytest.mark.parametrize("turned", [False, True])
def test_stripes_that_change_twice_as_often_from_line_to_line_run_the_other_way(
    turned: bool,
) -> None:
    good = np.ones((10, 10), bool)
    place = np.arange(10)
    numbers = np.minimum(place, 2) + 20 * np.minimum(place, 5)[:, None]
    check_direction(numbers - 20 * (place[:, None] >= 5), good, turned)
    ran, wanted = ("vertical", "horizontal") if turned else ("horizontal", "vertical")
    with pytest.raises(WrongDirection, match=f"run {ran}ly in the picture, not {wanted}ly"):
        check_direction(numbers, good, turned)
    good[1::2] = False  # nothing is known of what lies between lines then
    check_direction(numbers, good, turned)


def images(words: Indices, *, inverses: bool) -> ScanLines:
    """Sharp frames of code words (L, P)."""
    bit = words >> np.arange(BITS - 1, -1, -1)[:, None, None] & 1
    patterns = (20 + 100 * bit).astype(np.uint8)
    lit = np.full(words.shape, 120, np.uint8)
    other = 140 - patterns if inverses else None
    return ScanLines(lit, np.full_like(lit, 20), patterns, other, turned=False)


def check(words: Indices, code: WordCode, *, inverses: bool = True, stripes: int = 64) -> None:
    variance = np.full(256, 0.5, np.float32)
    sharp = images(words, inverses=inverses)
    check_codes(sharp, words.astype(np.uint16), code, stripes, variance)


def refused(words: Indices, code: WordCode, said: str, **asked: bool | int) -> None:
    with pytest.raises(DecodingFailed, match=said):
        check(words, code, **asked)  # type: ignore[arg-type]


def counted(stripe: Indices, code: WordCode = GRAY) -> Indices:
    return np.asarray(code.encode(stripe))


def changing(one: tuple[int, int], other: tuple[int, int], first: int, second: int) -> Indices:
    """Lines on which one word follows another, and then the finest bit turns to and fro; so many
    with the first two words and then with the others."""
    lines = []
    for before, after in (one,) * first + (other,) * second:
        rest = np.tile([after ^ 1] * 4 + [after] * 4, 3)
        lines.append(np.r_[[before] * 12, [after] * 12, rest])
    return np.array(lines)


UP = np.tile(np.arange(64).repeat(5), (40, 1))


@pytest.mark.parametrize("inverses", [False, True])
@pytest.mark.parametrize("code", [GRAY, BINARY])
def test_a_twentieth_of_the_codes_may_lie_beyond_the_last_stripe(
    code: WordCode, inverses: bool
) -> None:
    check(counted(UP, code), code, stripes=61, inverses=inverses)
    refused(
        counted(UP, code), code, "6% of the codes lie beyond", stripes=60, inverses=inverses
    )  # of 64


# Where bit 2 flips, 8 follows 7; a word that differs in that bit and lies farther off does not.
RIGHT = {GRAY: (4, 12), BINARY: (7, 8)}
WRONG = {GRAY: (0, 8), BINARY: (7, 9)}


@pytest.mark.parametrize(
    ("code", "inverses", "least"),
    [(GRAY, True, 50), (GRAY, False, 75), (BINARY, True, 60), (BINARY, False, 75)],
)
def test_how_many_changes_of_a_bit_have_to_be_between_neighbours(
    code: WordCode, inverses: bool, least: int
) -> None:
    check(changing(RIGHT[code], WRONG[code], least, 100 - least), code, inverses=inverses)
    said = "where bit 2 flips, stripes do not follow each other"
    wrong = changing(RIGHT[code], WRONG[code], least - 1, 101 - least)
    refused(wrong, code, said, inverses=inverses)


@pytest.mark.parametrize("inverses", [False, True])
def test_fewer_than_fifty_changes_of_a_bit_tell_nothing(inverses: bool) -> None:
    check(changing(RIGHT[GRAY], WRONG[GRAY], 0, 49), GRAY, inverses=inverses)
    refused(changing(RIGHT[GRAY], WRONG[GRAY], 0, 50), GRAY, "where bit 2", inverses=inverses)


@pytest.mark.parametrize("code", [GRAY, BINARY])
def test_stripes_that_count_down_on_a_seventh_of_the_picture_do_not_count_up(
    code: WordCode,
) -> None:
    """Every other line is looked at: 7 and 8 of 50."""
    for down, wrong in ((14, False), (16, True)):
        words = np.tile(np.arange(64).repeat(5), (100, 1))
        words[:down] = words[:down, ::-1]
        if wrong:
            refused(counted(words, code), code, "count up and down in turn", inverses=False)
        else:
            check(counted(words, code), code, inverses=False)


@pytest.mark.parametrize(("width", "wrong"), [(6, True), (8, False)])
def test_three_stripes_in_so_many_pixels_are_counting(width: int, wrong: bool) -> None:
    """Over 16 pixels; two may have been misread."""
    words = np.tile(np.arange(40).repeat(width), (120, 1))
    words[:60] = words[:60, ::-1]
    if wrong:
        refused(counted(words), GRAY, "count up and down in turn", inverses=False)
    else:
        check(counted(words), GRAY, inverses=False)


@pytest.mark.parametrize(("length", "wrong"), [(67, False), (68, True)])
def test_fifty_places_at_which_stripes_count_down_are_too_few_to_tell(
    length: int, wrong: bool
) -> None:
    """Of two lines with a dark one between; 17 of the places are the run-up."""
    up = np.arange(40).repeat(4)[:length]
    words = counted(np.array([up, up, up[::-1]]))
    sharp = images(words, inverses=False)
    sharp.lit[1] = 20

    def asked() -> None:
        check_codes(sharp, words.astype(np.uint16), GRAY, 64, np.ones(256, np.float32))

    if wrong:
        with pytest.raises(DecodingFailed, match="count up and down in turn"):
            asked()
    else:
        asked()


@pytest.mark.parametrize(("leap", "wrong"), [(1, True), (2, False)])
def test_what_falls_from_stripe_to_stripe_counts_down_and_what_leaps_is_an_edge(
    leap: int, wrong: bool
) -> None:
    """Down by three or more stripes within 16 pixels, in half of the lines."""
    rises = np.tile(np.arange(40).repeat(4), (120, 1))
    rises[:60] = np.maximum(63 - leap * np.arange(160) // 4, 0)
    words = counted(rises // leap * leap)
    if wrong:
        refused(words, GRAY, "count up and down in turn", inverses=False)
    else:
        check(words, GRAY, inverses=False)


def test_three_causes_are_named_at_most_the_simplest_first() -> None:
    """Words of the last four stripes of 64 where there are 32. More would undo it: any exchange of the
    coarsest bit, alone lit, for one of the next three."""
    words = counted(np.tile(np.arange(60, 64).repeat(5), (120, 1)))
    with pytest.raises(DecodingFailed) as refused_:
        check(words, GRAY, stripes=32)
    assert str(refused_.value).endswith(
        "it would fit if pattern and inverse of bit 0 were exchanged, or if bits 0 and 1 were "
        "exchanged, or if bits 0 and 2 were exchanged"
    )


def exchanged(words: Indices, one: int, other: int) -> Indices:
    """Of two bits, 0 the coarsest."""
    first, second = (1 << (BITS - 1 - bit) for bit in (one, other))
    rest = words & ~(first | second)
    return np.asarray(rest | (words & first > 0) * second | (words & second > 0) * first)


PICTURE = counted(np.tile(np.arange(60).repeat(5), (120, 1)))
REVERSED = exchanged(exchanged(exchanged(PICTURE, 0, 5), 1, 4), 2, 3)


@pytest.mark.parametrize(
    ("words", "cause"),
    [
        (PICTURE ^ 0b010000, "pattern and inverse of bit 1 were exchanged"),
        (PICTURE ^ 0b000001, "pattern and inverse of bit 5 were exchanged"),
        (PICTURE ^ 0b111111, "all patterns and inverses were exchanged"),
        (REVERSED, "the bits came in reverse order"),
        (exchanged(PICTURE, 1, 3), "bits 1 and 3 were exchanged"),
        (exchanged(PICTURE, 0, 5), "bits 0 and 5 were exchanged"),
    ],
)
def test_a_mistake_with_the_frames_is_named(words: Indices, cause: str) -> None:
    refused(words, GRAY, f"it would fit if (.*, or if )?{cause}", stripes=60)


@pytest.mark.parametrize(("right", "named"), [(79, False), (82, True)])
def test_a_cause_is_named_if_four_of_five_changes_of_each_bit_fit(right: int, named: bool) -> None:
    """The coarsest bit was exchanged, so that all words lie beyond; undone, bit 2 fits in so many."""
    words = changing(RIGHT[GRAY], WRONG[GRAY], right, 100 - right) ^ 0b100000
    with pytest.raises(DecodingFailed) as found:
        check(words, GRAY, stripes=32)
    assert ("if pattern and inverse of bit 0 were exchanged" in str(found.value)) == named
