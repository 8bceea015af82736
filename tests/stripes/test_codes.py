"""Stripe codes: the keys of a rig file, the images that they make, and that Gray code is read back."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from bodyscan.errors import BadInput
from bodyscan.geometry.light_planes import Axis
from bodyscan.stripes.codes import parse_stripe_code
from bodyscan.stripes.codes.gray import Gray, count_bits
from bodyscan.stripes.codes.phase_shift import PhaseShift
from bodyscan.stripes.codes.stripe_index import StripeIndex
from bodyscan.stripes.gray.bit_words import BINARY, GRAY
from bodyscan.stripes.stripe_code import StripeCode


def described(code: str, stripes: int = 64, **keys: Any) -> StripeCode:
    return parse_stripe_code({"code": code, "stripes": stripes, "direction": "vertical", **keys})


def waves(**keys: Any) -> PhaseShift:
    code = described("phase-shift", 64, **keys)
    assert isinstance(code, PhaseShift)
    return code


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
def test_images_by_kind(code: str, keys: dict[str, Any], expected: dict[str, int]) -> None:
    found = described(code, **keys)
    assert {kind.name: count for kind, count in found.image_counts.items()} == expected
    assert sorted(found.show_order) == list(range(sum(expected.values()))), "each is shown once"
    black = not keys.get("inverses", True)
    assert found.needs_dark is black
    assert found.needs_lit is (black or code == "stripe-index")


def test_show_order_has_the_finest_bits_in_the_middle() -> None:
    assert described("gray", inverses=False).show_order == (1, 3, 5, 4, 2, 0)
    assert described("gray", 32, inverses=False).show_order == (0, 2, 4, 3, 1)
    assert described("gray", 4).show_order == (1, 3, 0, 2)
    assert described("gray", 2).show_order == (0, 1)
    assert waves(inverses=False).show_order == tuple(range(8))


def test_time_at_which_a_stripe_map_holds() -> None:
    times = {"pattern": np.array([9.0, 1.0, 2.0]), "inverse": np.array([8.0, 7.0, 5.0])}
    assert described("gray", 8).moment(times) == 3.5
    assert waves().moment(times) == 5.0
    assert described("light-section").moment({"stripe": np.array([3.0, 4.0, 11.0])}) == 7.0


@pytest.mark.parametrize(
    ("code", "keys", "said"),
    [
        ("gray", {"stripes": 1}, "greater than or equal to 2"),
        ("phase-shift", {"period": []}, "at least 1 item"),
        ("phase-shift", {"periods": 33}, "gives waves of 1.93939 stripes"),
        ("phase-shift", {"period": 8, "periods": 8}, "repeats what period gives"),
        ("phase-shift", {"period": [8, 64], "steps": [3]}, "has 1 numbers, but there are 2 waves"),
        ("phase-shift", {"period": [8, 32]}, "repeat after 32 of 64"),
    ],
)
def test_invalid_keys(code: str, keys: dict[str, Any], said: str) -> None:
    with pytest.raises(ValidationError) as caught:
        described(code, **keys)
    assert said in str(caught.value)


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
    # Stripes one wide blur into each other, by a twenty-fifth of a pixel; those two wide do not.
    assert [GRAY.blur_sigma_px, BINARY.blur_sigma_px] == [0.0, 0.04]
    assert [
        GRAY.bit_two_wide(6),
        BINARY.bit_two_wide(6),
        BINARY.bit_two_wide(1),
        BINARY.bit_two_wide(2),
    ] == [5, 4, 0, 0]
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


@pytest.mark.parametrize("direction", ["horizontal", "vertical"])
@given(stripes=st.integers(2, 40))
def test_patterns_are_stripes_that_differ_in_one_bit_from_their_neighbours(
    direction: Axis, stripes: int
) -> None:
    spec = Gray(stripes=stripes, direction=direction)
    frames = spec.pattern_images(width=41, height=40)
    frames, inverses = np.split(frames, 2)
    np.testing.assert_array_equal(inverses, 255 - frames)
    assert frames.dtype == np.uint8
    assert frames.shape == (count_bits(stripes), 40, 41)
    assert set(np.unique(frames)) <= {0, 255}
    along, across = (2, 1) if direction == "horizontal" else (1, 2)
    assert np.all(frames == frames.take([0], axis=along))
    words = np.take(frames, 0, axis=along).T > 0
    changes = np.abs(np.diff(words.astype(int), axis=0)).sum(axis=1)
    assert changes.max() <= 1
    assert changes.sum() == stripes - 1
    assert len(np.unique(words, axis=0)) == stripes
    assert frames.shape[across] == (40 if direction == "horizontal" else 41)
    assert not words[0].any(), "stripe 0 is written as 0"


def test_a_stripe_index_image_is_one_of_an_instrument() -> None:
    code = StripeIndex(stripes=254, direction="vertical")
    assert sum(code.image_counts.values()) == 1
    assert not code.uses_dark
    assert not code.is_projected
    assert not code.has_edges
    with pytest.raises(BadInput, match="the output of an instrument"):
        code.pattern_images(640, 480)


def test_stripes_are_a_pixel_wide_at_least() -> None:
    code = Gray.model_validate({"stripes": 16, "direction": "vertical", "inverses": False})
    assert code.pattern_images(16, 2).shape == (4, 2, 16)
    with pytest.raises(BadInput, match="16 stripes do not fit on 15 projector pixels"):
        code.pattern_images(15, 2)
