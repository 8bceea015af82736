"""Stripes where other surfaces throw light too: dropped where it is most, put right where not."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from stripe_rendering import Sequence, decode_gray, gray_bits, render_sequence

from bodyscan.stripes.indirect_light import _beside, _mean_imbalance, mostly_direct
from bodyscan.stripes.scan_lines import WHOLE_SHARE
from bodyscan.stripes.stripe_map import StripeMap

STRIPES, PX = 50, 4.0
THERE = slice(12, 31)
"""Stripes on the surface that throws light back: its share of a bit is that of these."""
DIRECT = 180.0


def slanted(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    return 2.0 + u / PX * 0.7 + 0.02 * v


def is_shadowed(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    return np.where((u > 100) & (u < 160), np.nan, slanted(u, v))


def with_indirect(sequence: Sequence, grey: float) -> Sequence:
    """Light of the other surface added everywhere, `grey` when all of it is lit."""
    share = gray_bits(np.arange(STRIPES))[:, THERE].mean(axis=1)

    def more(image: np.ndarray, light: np.ndarray | float) -> np.ndarray:
        added = image + np.asarray(grey * light)[..., None, None]
        return np.clip(np.rint(added), 0, 255).astype(np.uint8).reshape(image.shape)

    return Sequence(
        more(sequence.lit, 1.0),
        sequence.dark,
        more(sequence.patterns, share),
        more(sequence.inverses, 1.0 - share),
        sequence.s,
    )


def read(sequence: Sequence) -> StripeMap:
    frames = (sequence.lit, sequence.dark, sequence.patterns, sequence.inverses)
    return decode_gray(*frames, stripes=STRIPES, direction="vertical")


def rms(found: StripeMap, s: np.ndarray) -> float:
    known = np.isfinite(found.s) & np.isfinite(s)
    assert known.sum() > 0.9 * np.isfinite(s).sum()
    return float(np.sqrt(np.mean((found.s - s)[known] ** 2)))


def test_boundaries_lie_in_the_middle_of_what_both_sides_show() -> None:
    """A fifth of the light comes by another way. Where the coarsest bits flip, their differences
    are J, up to a fifth of D, in the middle: taken for 0, their boundaries would be off by a quarter
    of the blur and more, up to 0.1 stripes."""
    plain = render_sequence(slanted, stripes=STRIPES, light=DIRECT, noise=0.7)
    mixed = read(with_indirect(plain, 50.0))
    # 0.0020 without the other surface's light, 0.0047 with it, 0.020 if J is taken for 0. The finest
    # bit's boundaries are left as they are: its J is a nineteenth of I, which moves them by 0.004.
    assert rms(mixed, plain.s) < 0.006
    u, v = mixed.boundary_pixels.T
    off = slanted(u, v) - mixed.boundary_index
    # Each is seen on 200 lines, to 0.003 stripes; taken for 0, J would move the worst by 0.10.
    for index in range(6, 46):
        assert abs(np.median(off[mixed.boundary_index == index])) < 0.006, index


def test_a_shadow_that_other_surfaces_light_shows_no_stripes() -> None:
    plain = render_sequence(is_shadowed, stripes=STRIPES, light=DIRECT, ambient=15.0, noise=0.7)
    shade = np.zeros(plain.s.shape, bool)
    shade[:, 104:157] = True  # clear of the rims, which are partly lit
    mixed = read(with_indirect(plain, 30.0))
    assert np.isfinite(mixed.s[shade]).mean() == 0.0
    rest = ~np.isin(np.arange(plain.s.shape[1]), range(96, 165))
    assert np.isfinite(mixed.s[:, rest]).mean() == pytest.approx(
        np.isfinite(read(plain).s[:, rest]).mean(), abs=0.002
    )


@pytest.mark.parametrize("pixels", [1.3, 2.0, 6.0])
def test_direct_light_is_never_taken_for_indirect(
    pixels: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever the stripes' width: all pixels that were read without asking are read."""
    plain = render_sequence(
        lambda u, v: 0.5 + u / pixels, stripes=int(250 / pixels), light=60.0, noise=1.0
    )
    frames = (plain.lit, plain.dark, plain.patterns, plain.inverses)
    found = decode_gray(*frames, stripes=int(250 / pixels), direction="vertical")
    monkeypatch.setattr("bodyscan.stripes.indirect_light.LEAST_DIRECT", -1.0)
    everything = decode_gray(*frames, stripes=int(250 / pixels), direction="vertical")
    assert np.isfinite(everything.s).mean() > 0.8
    assert np.isfinite(found.s).sum() >= 0.999 * np.isfinite(everything.s).sum()


def beside(
    at: int, index: int, reach: int, codes: np.ndarray, usable: np.ndarray | None = None
) -> list[int]:
    """Pixels on the first side of a boundary behind pixel `at` of the second line of two."""
    both = np.stack([np.zeros_like(codes), codes]).astype(np.int32)
    shown = np.ones(both.shape, bool) if usable is None else np.stack([usable, usable])
    width = codes.size
    found = _beside(both, shown, np.array([width + at]), np.array([index]), np.array([reach]))[0]
    one, other = found[::2], found[1::2]
    assert ((one < 0) == (other < 0)).all(), "both or neither"
    known = one >= 0
    assert (one[known] - width + other[known] - width == 2 * at + 1).all(), "as far on either side"
    return [int(each) - width for each in one[known]]


def test_pixels_beside_a_boundary_are_clear_of_it_and_of_the_next_flips() -> None:
    """Stripes of 4 px: 3 px before the last pixel of stripe 4 is the first of it, and then stripe 3."""
    codes = np.arange(40) // 4
    assert beside(19, 5, 2, codes) == [16, 15, 14, 13]
    assert beside(19, 5, 1, codes) == [16]
    assert beside(19, 9, 20, codes) == [], "both sides lie before where another boundary is"
    falling = codes[::-1].copy()
    assert beside(19, 5, 2, falling) == [16, 15, 14, 13]
    # The picture ends, or what is on one side is of no use.
    assert beside(3, 1, 2, codes) == [0]
    assert beside(35, 9, 2, codes) == [32]
    hidden = np.ones(40, bool)
    hidden[24] = False
    assert beside(19, 5, 2, codes, hidden) == [16, 14, 13]


@pytest.mark.parametrize(("shared", "found"), [(0.1, 0.1), (-0.15, -0.15), (0.3, 0.2)])
def test_what_a_pattern_and_its_inverse_do_not_share_is_the_middle_between_both_sides(
    shared: float, found: float
) -> None:
    """Four fifths come straight: of the rest no more than all is not shared."""
    lit, dark = np.full(40, 110, np.uint8), np.full(40, 10, np.uint8)
    pixels = np.array([[16, 23, -1, -1], [-1, -1, -1, -1]])
    straight = np.array([[0.8, -0.8, 9.9, 9.9]] * 2)
    difference = (100.0 * (straight + min(abs(shared), 0.2) * np.sign(shared))).astype(np.float32)
    quiet = np.zeros((2, 4), np.float32)
    mean, doubt = _mean_imbalance(lit, dark, pixels, difference, quiet)
    np.testing.assert_allclose(mean, [found, 0.0], rtol=1e-5)
    np.testing.assert_allclose(doubt, [0.3 * abs(found), 0.0], rtol=1e-5)
    # Where noise may be all of it, it is half believed at four sigmas.
    noise = np.full((2, 4), 100.0 * abs(found) / 4.0 * np.sqrt(2.0), np.float32)
    half, unsure = _mean_imbalance(lit, dark, pixels, difference, noise)
    assert half[0] == pytest.approx(0.5 * found, rel=1e-4)
    assert unsure[0] == pytest.approx(abs(found) * np.hypot(0.25, 0.15), rel=1e-4)


class Shares:
    """Bits of which so much is direct, in the order of their fineness from `finest` down."""

    def __init__(self, finest: int, *shares: np.ndarray) -> None:
        self.of_bit = {finest - k: share for k, share in enumerate(shares)}
        self.asked: list[int] = []

    def direct_share(self, bit: int, variance: Any) -> np.ndarray:
        self.asked.append(bit)
        return np.rint(WHOLE_SHARE * self.of_bit[bit]).astype(np.uint8)[None].repeat(3, axis=0)


def direct(shares: Shares, usable: np.ndarray | None = None) -> list[bool]:
    images: Any = shares
    nothing: Any = None
    every = np.ones(200, bool) if usable is None else usable
    found = mostly_direct(images, every[None].repeat(3, axis=0), 6, nothing)
    assert (found == found[0]).all()
    return list(found[0].tolist())


def test_where_half_of_the_light_is_direct_a_pixel_counts_and_where_a_bit_flips_it_is_filled() -> (
    None
):
    share = np.ones(200)
    share[20:26], share[40:47] = 0.1, 0.1  # six pixels are a flip, seven are not
    share[60:80], share[100:120] = 0.51, 0.49
    expected = np.ones(200, bool)
    expected[40:47] = expected[100:120] = False
    assert direct(Shares(6, share)) == expected.tolist()


def test_the_next_coarser_bit_tells_where_the_finest_is_blurred_for_nine_of_ten_pixels() -> None:
    place = np.arange(200)
    for clear, asked in ((20, [6]), (19, [6, 5])):
        # Sharp is what has four fifths.
        blurred, coarse = np.where(place < clear, 0.81, 0.4), np.where(place < 150, 1.0, 0.4)
        shares = Shares(6, blurred, coarse)
        told = place < (clear if asked == [6] else 150)
        assert direct(shares) == told.tolist()
        assert shares.asked == asked
    # Of those that are looked at alone; and where none is sharp, nothing is told of any.
    assert direct(Shares(6, np.where(place < 10, 0.81, 0.4)), place < 100) == (place < 10).tolist()
    dull = np.full(200, 0.79)
    shares = Shares(6, dull, dull, dull)
    assert all(direct(shares))
    assert shares.asked == [6, 5, 4]
