"""What a rig file may say of a code, how many images that makes, in which order, and what they show."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from bodyscan.stripes.codes import stripe_code
from bodyscan.stripes.codes.gray import bits_needed
from bodyscan.stripes.codes.phase_shift import PhaseShift
from bodyscan.stripes.gray.bit_words import BINARY, GRAY
from bodyscan.stripes.stripe_code import StripeCode


def described(code: str, stripes: int = 64, **keys: Any) -> StripeCode:
    return stripe_code({"code": code, "stripes": stripes, "direction": "vertical", **keys})


def counts(code: StripeCode) -> dict[str, int]:
    return {kind.name: count for kind, count in code.image_counts.items()}


def waves(stripes: int = 64, **keys: Any) -> PhaseShift:
    code = described("phase-shift", stripes, **keys)
    assert isinstance(code, PhaseShift)
    return code


@pytest.mark.parametrize(
    ("words", "bits"), [(2, 1), (3, 2), (4, 2), (5, 3), (256, 8), (257, 9), (65536, 16)]
)
def test_so_many_words_need_so_many_bits(words: int, bits: int) -> None:
    assert bits_needed(words) == bits


@pytest.mark.parametrize(
    ("code", "keys", "expected"),
    [
        ("gray", {}, {"pattern": 6, "inverse": 6}),
        ("gray", {"inverses": False}, {"pattern": 6}),
        ("gray", {"first_code": 1}, {"pattern": 7, "inverse": 7}),
        ("gray", {"stripes": 65}, {"pattern": 7, "inverse": 7}),
        ("binary", {"first_code": 192}, {"pattern": 8, "inverse": 8}),
        ("light-section", {}, {"stripe": 64}),
        ("stripe-index", {}, {"index": 1}),
        # Eight stripes a period and four steps, if nothing is said: 16 half periods.
        ("phase-shift", {}, {"pattern": 4, "inverse": 4, "phase": 4}),
        ("phase-shift", {"period": 7}, {"pattern": 5, "inverse": 5, "phase": 4}),
        ("phase-shift", {"periods": 4, "steps": 5, "inverses": False}, {"pattern": 3, "phase": 5}),
        ("phase-shift", {"period": 64}, {"phase": 4}),
        ("phase-shift", {"period": (8, 64), "steps": (6, 3)}, {"phase": 9}),
        ("phase-shift", {"stripes": 6}, {"phase": 4}),
    ],
)
def test_a_code_has_so_many_images(
    code: str, keys: dict[str, Any], expected: dict[str, int]
) -> None:
    found = described(code, **keys)
    assert counts(found) == expected
    assert sorted(found.show_order) == list(range(sum(expected.values()))), "each is shown once"
    black = not keys.get("inverses", True)
    assert found.needs_dark is black
    assert found.needs_lit is (black or code == "stripe-index")


def test_the_finest_bits_are_shown_in_the_middle_with_their_inverses_beside() -> None:
    assert described("gray", inverses=False).show_order == (1, 3, 5, 4, 2, 0)
    assert described("gray", 32, inverses=False).show_order == (0, 2, 4, 3, 1)
    assert described("gray", 4).show_order == (1, 3, 0, 2)
    assert described("gray", 2).show_order == (0, 1)
    assert waves(inverses=False).show_order == tuple(range(8))


def test_a_map_stands_for_the_moment_of_the_finest_bit_or_the_middle_of_all() -> None:
    times = {"pattern": np.array([9.0, 1.0, 2.0]), "inverse": np.array([8.0, 7.0, 5.0])}
    assert described("gray", 8).moment(times) == 3.5
    assert waves().moment(times) == 5.0
    assert described("light-section").moment({"stripe": np.array([3.0, 4.0, 11.0])}) == 7.0


@pytest.mark.parametrize(
    ("code", "keys"),
    [
        ("gray", {"stripes": 2}),
        ("gray", {"stripes": 65535}),
        ("gray", {"first_code": 65472}),
        ("stripe-index", {"stripes": 254}),
        ("phase-shift", {"steps": 3}),
        ("phase-shift", {"steps": 64}),
        ("phase-shift", {"period": 2}),
        ("phase-shift", {"period": [64]}),
        ("phase-shift", {"periods": [1], "steps": [3]}),
        ("phase-shift", {"periods": 32}),
        ("phase-shift", {"periods": 0.5}),
        ("phase-shift", {"period": [8, 64, 9, 10, 11, 12, 13, 14], "steps": [3] * 8}),
        ("phase-shift", {"start_deg": -360, "origin": -65535}),
        ("phase-shift", {"start_deg": 360, "origin": 65535}),
    ],
)
def test_what_can_be_is_taken(code: str, keys: dict[str, Any]) -> None:
    described(code, **keys)


@pytest.mark.parametrize(
    ("code", "keys", "said"),
    [
        ("gray", {"stripes": 1}, "greater than or equal to 2"),
        ("gray", {"stripes": 65536}, "less than or equal to 65535"),
        ("gray", {"first_code": -1}, "greater than or equal to 0"),
        ("gray", {"first_code": 65473}, "must be 65472 or less"),
        ("stripe-index", {"stripes": 255}, "must be 254 or less"),
        ("phase-shift", {"steps": 2}, "greater than or equal to 3"),
        ("phase-shift", {"steps": 65}, "less than or equal to 64"),
        ("phase-shift", {"period": 1.9}, "greater than or equal to 2"),
        ("phase-shift", {"period": []}, "at least 1 item"),
        ("phase-shift", {"period": [64] * 9}, "at most 8 items"),
        ("phase-shift", {"period": 65}, "must be 64 (stripes) or less (got 65)"),
        ("phase-shift", {"periods": 33}, "gives waves of 1.93939 stripes"),
        ("phase-shift", {"periods": 0}, "greater than 0"),
        ("phase-shift", {"period": 8, "periods": 8}, "repeats what period gives"),
        ("phase-shift", {"period": [8, 64], "steps": [3]}, "has 1 numbers, but there are 2 waves"),
        ("phase-shift", {"period": [8, 32]}, "repeat after 32 of 64"),
        ("phase-shift", {"start_deg": -361}, "greater than or equal to -360"),
        ("phase-shift", {"start_deg": 361}, "less than or equal to 360"),
        ("phase-shift", {"origin": 65536}, "less than or equal to 65535"),
    ],
)
def test_what_cannot_be_is_refused(code: str, keys: dict[str, Any], said: str) -> None:
    with pytest.raises(ValidationError) as caught:
        described(code, **keys)
    assert said in str(caught.value)


def test_waves_nearly_alike_again_are_told_apart_by_no_camera() -> None:
    # After 8 waves of 8 a wave of 63.75 is 64 / 63.75 = 1.0039 turns on; of 63.73, 1.0042.
    with pytest.raises(ValidationError, match="repeat after 64"):
        waves(70, period=(8, 63.75))
    assert len(waves(70, period=(8, 63.73)).waves) == 2


def test_waves_are_as_described() -> None:
    first, second = waves(
        period=(8, 64), steps=(6, 3), shift="backward", start_deg=90, origin=2.5
    ).waves
    assert (first.period, first.steps, second.period, second.steps) == (8.0, 6, 64.0, 3)
    assert first.start == pytest.approx(np.pi / 2.0)
    assert first.origin == 2.5
    assert first.sign == -1.0
    (one,) = waves(periods=5).waves
    assert one.period == 12.8
    (only,) = waves(6).waves
    assert only.period == 6.0
    assert (only.start, only.origin, only.sign, only.steps) == (0.0, 0.0, 1.0, 4)


@pytest.mark.parametrize(
    ("stripes", "period", "halves"),
    [(64, 8.0, 16), (64, 7.0, 19), (60, 40.0, 3), (61, 40.0, 4), (100, 0.1 * 30, 67)],
)
def test_half_periods_are_counted_the_last_one_perhaps_in_part(
    stripes: int, period: float, halves: int
) -> None:
    assert waves(stripes, period=period).half_periods == halves


def test_patterns_show_a_stripes_number_in_bits_the_coarsest_first() -> None:
    s = np.array([0.0, 0.99, 1.0, 2.5, 3.0])
    plain = described("binary", 4, first_code=3)
    pattern, inverse = plain.image_counts
    # 3, 3, 4, 5, 6.
    assert plain.intensity(pattern, s).T.tolist() == [
        [0, 1, 1], [0, 1, 1], [1, 0, 0], [1, 0, 1], [1, 1, 0],
    ]  # fmt: skip
    gray = described("gray", 4, first_code=3)
    # 3 ^ 1 = 2, 4 ^ 2 = 6, 5 ^ 2 = 7, 6 ^ 3 = 5.
    assert gray.intensity(pattern, s).T.tolist() == [
        [0, 1, 0], [0, 1, 0], [1, 1, 0], [1, 1, 1], [1, 0, 1],
    ]  # fmt: skip
    np.testing.assert_array_equal(gray.intensity(inverse, s), 1.0 - gray.intensity(pattern, s))
    line = described("light-section", 4)
    (kind,) = line.image_counts
    assert line.intensity(kind, s).T.tolist() == [
        [1, 0, 0, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1],
    ]  # fmt: skip


def test_words_are_read_as_they_were_written() -> None:
    numbers = np.arange(1 << 16)
    for code in (GRAY, BINARY):
        words = code.encode(numbers).astype(np.uint16)
        assert np.array_equal(code.stripes(words), numbers)
        later = type(code)(code.encode, code.decode, code.single, code.blur_sigma_px, first=5)
        assert np.array_equal(later.stripes(words), numbers - 5)
    assert [GRAY.finest_run, BINARY.finest_run] == [2, 1]
    # Stripes one wide blur into each other, by a twenty-fifth of a pixel; those two wide do not.
    assert [GRAY.blur_sigma_px, BINARY.blur_sigma_px] == [0.0, 0.04]
    assert [
        GRAY.bit_two_wide(6),
        BINARY.bit_two_wide(6),
        BINARY.bit_two_wide(1),
        BINARY.bit_two_wide(2),
    ] == [
        5,
        4,
        0,
        0,
    ]
    flips = np.diff(GRAY.bits(np.arange(8), 3), axis=1) != 0
    assert np.all(flips.sum(axis=0) == 1)


def test_crossing_stripes_run_the_other_way_and_are_no_more_than_two() -> None:
    across = {"code": "gray", "stripes": 32, "direction": "horizontal"}
    both = described("gray", crossing=across)
    assert [way.stripes for way in both.directions] == [64, 32]
    assert len(described("gray").directions) == 1
    for wrong, said in (
        ({**across, "direction": "vertical"}, "must not be vertical as well"),
        ({**across, "crossing": {**across, "direction": "vertical"}}, "stripes run two ways"),
        ({**across, "code": "stripe-index"}, "is for projectors that show images"),
    ):
        with pytest.raises(ValidationError) as caught:
            described("gray", crossing=wrong)
        assert said in str(caught.value)
