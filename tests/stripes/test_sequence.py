"""Stripe sequences that do not add up are refused, and the frame to blame is named."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from stripe_rendering import Sequence, render_sequence

from bodyscan.arrays import Bytes
from bodyscan.errors import DecodingFailed
from bodyscan.stripes.codes import parse_stripe_code
from bodyscan.stripes.codes.gray import Gray
from bodyscan.stripes.decoding import decode_stripes
from bodyscan.stripes.gray.sequence_checks import _compare_pairs
from bodyscan.stripes.stripe_code import StripeCode
from bodyscan.stripes.stripe_map import StripeMap

STRIPES, BITS = 100, 7


@pytest.fixture(scope="module")
def good() -> Sequence:
    return render_sequence(
        lambda u, v: 1.2 + (v + 0.1 * u + 2 * np.sin(u / 20)) / 2.3, stripes=STRIPES
    )


def read(sequence: Sequence) -> StripeMap:
    return sequence.decode(STRIPES)


def reordered(sequence: Sequence, order: list[int]) -> Sequence:
    return replace(sequence, patterns=sequence.patterns[order], inverses=sequence.inverses[order])


def with_frame(sequence: Sequence, name: str, bit: int, frame: Bytes) -> Sequence:
    frames = getattr(sequence, name).copy()
    frames[bit] = frame
    return replace(sequence, **{name: frames})


def test_reversed_bits_and_exchanged_lists_are_refused(good: Sequence) -> None:
    with pytest.raises(DecodingFailed, match="swapped, missing or out of order"):
        read(reordered(good, list(range(BITS))[::-1]))
    with pytest.raises(DecodingFailed, match="swapped, missing or out of order"):
        read(replace(good, patterns=good.inverses, inverses=good.patterns))


@pytest.mark.parametrize("bit", [0, 3, 6])
def test_a_frame_taken_twice_or_missing_is_named(good: Sequence, bit: int) -> None:
    with pytest.raises(DecodingFailed, match=f"bit {bit} look alike"):
        read(with_frame(good, "inverses", bit, good.patterns[bit]))
    if bit < BITS - 1:  # of the finest, no finer one tells; a stripe's half is at stake there
        with pytest.raises(DecodingFailed, match=f"bit {bit} is faint where finer ones are clear"):
            read(with_frame(good, "patterns", bit, good.dark))
        with pytest.raises(DecodingFailed):
            read(with_frame(good, "inverses", bit, good.patterns[bit + 1]))
        return
    for name in ("patterns", "inverses"):
        with pytest.raises(DecodingFailed, match=f"{name[:-1]} of bit 6 are the same image"):
            read(with_frame(good, name, bit, getattr(good, name)[bit - 1]))


@pytest.mark.parametrize(
    ("name", "bit", "added", "part"),
    [
        ("patterns", 5, 40, 1.0),
        ("inverses", 3, 90, 1.0),
        ("patterns", 1, 150, 0.2),
        ("inverses", 6, 25, 0.1),
    ],
)
def test_a_frame_that_a_flash_lit_is_named_and_made_from_the_other(
    good: Sequence, name: str, bit: int, added: int, part: float
) -> None:
    light = added * (np.arange(good.lit.shape[1]) < part * good.lit.shape[1])
    lit = np.minimum(getattr(good, name)[bit] + light, 255).astype(np.uint8)
    found, calm = read(with_frame(good, name, bit, lit)), read(good)
    (fault,) = found.faults
    assert f"the {name[:-1]} of bit {bit} is" in fault
    assert not calm.faults
    known = np.isfinite(found.s) & np.isfinite(calm.s)
    assert known.sum() > 0.99 * np.isfinite(calm.s).sum()
    assert np.sqrt(np.mean((found.s - calm.s)[known] ** 2)) < 0.01


def test_neither_flicker_nor_the_noise_of_a_dim_picture_is_a_flash(good: Sequence) -> None:
    """Skin that flickered had sound frames made from others: 0.206 mm for 0.160. Legs far from the
    lamps have a contrast of ten levels, four frames' noise is three, and bit 0 is white all over."""
    rng = np.random.default_rng(4)
    gains = rng.uniform(0.9, 1.05, (2, BITS, 1, 1))
    patterns, inverses = (
        np.clip(gain * stack, 0, 255).astype(np.uint8)
        for gain, stack in zip(gains, (good.patterns, good.inverses), strict=True)
    )
    assert not read(replace(good, patterns=patterns, inverses=inverses)).faults
    for name in ("lit", "dark", "patterns", "inverses"):
        dim = 10.0 + 0.06 * getattr(good, name)[..., 130:, :]
        noisy = np.rint(dim + 1.2 * rng.standard_normal(dim.shape)).astype(np.uint8)
        good = replace(good, **{name: noisy})
    assert not read(good).faults
    # Where noise makes the finest bit clear, a coarser one changes.
    rng = np.random.default_rng(0)
    turn = rng.uniform(0.0, 2.0 * np.pi, 5000)
    waves = 9.0 * np.stack([np.sin(turn / 2.0), np.sin(turn), np.cos(2.0 * turn)])
    noisy = 60.0 + 0.5 * np.stack([waves, -waves]) + rng.normal(0.0, 0.8, (2, 3, 5000))
    pattern, inverse = np.rint(noisy).astype(np.uint8)
    assert not _compare_pairs(pattern, inverse, np.full(256, np.float32(0.64)))


def test_a_missing_first_bit_is_named_in_the_remedy(good: Sequence) -> None:
    """Codes of the other half read as stripes beyond the last, or count back."""
    half = replace(good, patterns=good.patterns[1:], inverses=good.inverses[1:])
    with pytest.raises(DecodingFailed) as refused:
        half.decode(STRIPES // 2)
    assert re.search("none is missing|bit 0 is missing", str(refused.value.remedy))


def test_a_rim_where_one_bit_alone_flips_is_no_wrong_order() -> None:
    """A board before a dark wall: stripe 14 of the wall meets stripe 49 of the board, whose words
    differ in bit 1, which flips nowhere else in the picture."""

    scene = render_sequence(
        lambda u, v: np.where(v < 120, 14.3 + (v - 120) / 12, 49.4 + (v - 120) / 3),
        stripes=STRIPES,
        albedo=lambda u, v: np.where(v < 120, 0.25, 1.0),
    )
    assert np.isfinite(read(scene).s).mean() > 0.5
    with pytest.raises(DecodingFailed, match="swapped, missing or out of order"):
        read(reordered(scene, [0, 1, 2, 4, 3, 5, 6]))


@pytest.mark.parametrize("factor", [0.5, 1.25])
def test_lit_and_dark_exposed_otherwise_are_made_from_the_patterns(
    good: Sequence, factor: float
) -> None:
    """Cameras that expose by themselves darken the lit image, which is twice as bright as a pattern."""

    def exposed(frame: Bytes) -> Bytes:
        return np.clip(frame * factor, 0, 255).astype(np.uint8)

    right = read(good)
    found = read(replace(good, lit=exposed(good.lit), dark=exposed(good.dark)))
    both = np.isfinite(found.s) & np.isfinite(right.s)
    assert both.sum() > 0.97 * np.isfinite(right.s).sum()
    assert np.sqrt(np.mean((found.s - good.s)[both] ** 2)) < 1.1 * np.sqrt(
        np.mean((right.s - good.s)[both] ** 2)
    )


def test_non_linear_grey_levels(good: Sequence) -> None:
    """Gamma of 2.2: blurred patterns and their inverses together are far brighter than lit and dark."""

    def bent(frames: Bytes) -> Bytes:
        return np.rint(255.0 * (frames / 255.0) ** (1.0 / 2.2)).astype(np.uint8)

    right = read(good)
    found = read(
        replace(
            good, lit=bent(good.lit), dark=bent(good.dark),
            patterns=bent(good.patterns), inverses=bent(good.inverses),
        )
    )  # fmt: skip
    both = np.isfinite(found.s) & np.isfinite(right.s)
    assert both.sum() > 0.95 * np.isfinite(right.s).sum()
    error = (found.s - good.s)[both]
    assert np.sqrt(np.mean(error**2)) < 2.0 * np.sqrt(np.mean((right.s - good.s)[both] ** 2))
    # Noise-free images: sigma allows for grey levels rounded, and 1 would need noise.
    assert 0.5 < np.sqrt(np.mean((error / found.sigma[both]) ** 2)) < 1.25


@pytest.mark.parametrize("made", ["lit", "dark", "both"])
def test_lit_and_dark_are_made_where_none_was_taken(good: Sequence, made: str) -> None:
    lit = None if made in ("lit", "both") else good.lit
    dark = None if made in ("dark", "both") else good.dark
    coded = np.concatenate([good.patterns, good.inverses])
    code = Gray(stripes=STRIPES, direction="horizontal")
    right, found = read(good), decode_stripes(code, lit, dark, coded)
    both = np.isfinite(found.s) & np.isfinite(right.s)
    assert both.sum() > 0.97 * np.isfinite(right.s).sum()
    assert np.sqrt(np.mean((found.s - right.s)[both] ** 2)) < 0.01


@pytest.mark.parametrize("first", [28])
def test_codes_may_count_from_another_number(first: int) -> None:
    """100 stripes in the middle of 128 codes; the images are those of stripes 14 to 113 of 128."""
    whole = render_sequence(
        lambda u, v: first + 1.2 + (v + 0.1 * u + 2 * np.sin(u / 20)) / 2.3, stripes=128
    )
    spec = Gray(stripes=STRIPES, direction="horizontal", first_code=first)
    coded = np.concatenate([whole.patterns, whole.inverses])
    found = decode_stripes(spec, whole.lit, whole.dark, coded)
    told = np.isfinite(found.s)
    assert told.mean() > 0.9
    assert np.sqrt(np.mean((found.s + first - whole.s)[told] ** 2)) < 0.02
    assert found.boundary_index.min() >= 1
    assert found.boundary_index.max() < STRIPES
    with pytest.raises(DecodingFailed, match="of the codes lie beyond the last stripe"):
        decode_stripes(spec.model_copy(update={"first_code": 0}), whole.lit, whole.dark, coded)


def test_a_blurred_finest_bit_costs_only_pixels(good: Sequence) -> None:
    """Even grey in both: 50 of 100 stripes can be told, and what has a value is right to a stripe."""
    rng = np.random.default_rng(2)
    middle = (good.lit.astype(float) + good.dark) / 2.0
    blurred = with_frame(
        good, "patterns", BITS - 1, np.rint(rng.normal(middle, 1.0)).astype(np.uint8)
    )
    blurred = with_frame(
        blurred, "inverses", BITS - 1, np.rint(rng.normal(middle, 1.0)).astype(np.uint8)
    )
    found = read(blurred)
    told = np.isfinite(found.s)
    assert told.mean() > 0.3
    error = (found.s - good.s)[told]
    assert np.mean(np.abs(error) < 1.0) > 0.99
    assert 0.8 < np.sqrt(np.mean((error / found.sigma[told]) ** 2)) < 1.25
    with pytest.raises(DecodingFailed, match="bit 6 look alike"):
        read(with_frame(blurred, "inverses", BITS - 1, blurred.patterns[BITS - 1]))


def test_faults_of_crossing_stripes_are_reported_as_theirs(good: Sequence) -> None:
    """Rows twice: the second time as if they were columns; and the other way about."""
    coded = np.concatenate([good.patterns, good.inverses])
    twice = np.concatenate([coded, coded])

    def code(direction: str) -> StripeCode:
        both = {"code": "gray", "stripes": STRIPES, "crossing": {"stripes": STRIPES}}
        return parse_stripe_code({**both, "direction": direction})

    found = decode_stripes(code("horizontal"), good.lit, good.dark, twice)
    assert found.crossing is None
    assert re.match(r"the stripes run horizontally.*\n  exchange", found.crossing_fault)
    np.testing.assert_array_equal(found.s, read(good).s)
    with pytest.raises(DecodingFailed, match=r"^the stripes run horizontally") as caught:
        decode_stripes(code("vertical"), good.lit, good.dark, twice)
    assert "direction: horizontal" in caught.value.remedy
