"""Stripes where other surfaces throw light too: dropped where it is most, put right where not."""

from __future__ import annotations

import numpy as np
import pytest
from stripe_rendering import Sequence, decode_gray, gray_bits, render_sequence

from bodyscan.arrays import Floats
from bodyscan.stripes import usable_pixels
from bodyscan.stripes.boundaries import measure_imbalance
from bodyscan.stripes.scan_lines import ScanLines
from bodyscan.stripes.stripe_map import StripeMap
from bodyscan.stripes.usable_pixels import find_direct_pixels

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


def test_boundaries_are_corrected_for_indirect_light() -> None:
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


def test_a_shadow_lit_by_another_surface_has_no_s() -> None:
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
    monkeypatch.setattr(usable_pixels, "find_direct_pixels", lambda _, usable, *__: usable | True)
    everything = decode_gray(*frames, stripes=int(250 / pixels), direction="vertical")
    assert np.isfinite(everything.s).mean() > 0.8
    assert np.isfinite(found.s).sum() >= 0.999 * np.isfinite(everything.s).sum()


QUIET = np.full(256, 1e-6, np.float32)
SHAPE = (20, 60)
BITS = 5


def lit_by(direct: np.ndarray, *, bits: dict[int, float] | None = None) -> ScanLines:
    """120 grey levels of light, of which the projector's part is `direct` (L, P); bits: what share of
    it a pattern shows."""
    dark: Floats = np.full(SHAPE, 20.0, np.float32)
    lit = dark + np.float32(120.0)
    shown = np.array([(bits or {}).get(k, 1.0) for k in range(BITS)])[:, None, None]
    step = np.float32(60.0) * (shown * direct).astype(np.float32)
    return ScanLines(lit, dark, np.float32(80.0) + step, np.float32(80.0) - step, False)


def direct_light() -> np.ndarray:
    """A clear top, and below it on the left more and on the right less than half."""
    direct = np.ones(SHAPE)
    direct[8:, :30], direct[8:, 30:] = 0.55, 0.45
    return direct


EVERY = np.ones(SHAPE, bool)


def test_pixels_with_mostly_indirect_light_are_excluded() -> None:
    direct = direct_light()
    assert np.array_equal(find_direct_pixels(lit_by(direct), EVERY, 4, QUIET), direct > 0.5)
    # A dark pattern tells as much as a bright one.
    assert np.array_equal(find_direct_pixels(lit_by(-direct), EVERY, 4, QUIET), direct > 0.5)


def test_a_blurred_finest_bit_is_replaced_by_a_coarser_one() -> None:
    direct = direct_light()
    for blurred in ({4: 0.7}, {4: 0.7, 3: 0.7}):
        found = find_direct_pixels(lit_by(direct, bits=blurred), EVERY, 4, QUIET)
        assert np.array_equal(found, direct > 0.5)
    # After three none tells anything.
    images = lit_by(direct, bits={4: 0.7, 3: 0.7, 2: 0.7})
    assert find_direct_pixels(images, EVERY, 4, QUIET).all()
    assert find_direct_pixels(lit_by(direct, bits={0: 0.7}), EVERY, 0, QUIET).all()


def test_dips_where_a_bit_flips_are_filled_and_wider_ones_are_shadows() -> None:
    direct = np.ones(SHAPE)
    direct[:, 20:26] = 0.1
    direct[:, 40:47] = 0.1
    found = find_direct_pixels(lit_by(direct), EVERY, 4, QUIET)
    assert found[:, :40].all()
    assert not found[:, 40:47].any()


def at_boundary(
    indirect: float, unshared: float, *, noise: float = 1e-6, reach: int = 8, second: int = 60
) -> tuple[float, float]:
    """J and its doubt of a boundary between pixels 29 and 30 at stripe 15; a pixel gets D + I, its
    pattern less its inverse +-D + J.  second: where the bit flips again."""
    total = 100.0
    u = np.arange(SHAPE[1])
    sign = np.where((u >= 30) & (u < second), 1.0, -1.0)
    difference = np.tile(total * ((1.0 - indirect) * sign + unshared), (SHAPE[0], 1))
    dark: Floats = np.full(SHAPE, 20.0, np.float32)
    patterns = (80.0 + difference / 2.0).astype(np.float32)[None]
    inverses = (80.0 - difference / 2.0).astype(np.float32)[None]
    images = ScanLines(dark + np.float32(total), dark, patterns, inverses, False)
    codes = np.tile(u // 2, (SHAPE[0], 1)).astype(np.int32)
    one = np.array([0])
    levels = np.full(256, noise, np.float32)
    mean, doubt = measure_imbalance(
        images,
        codes,
        EVERY,
        levels,
        one,
        np.array([15]),
        np.array([5 * 60 + 29]),
        np.array([reach]),
    )
    return float(mean[0]), float(doubt[0])


@pytest.mark.parametrize("unshared", [0.1, -0.2])
def test_imbalance_is_the_mean_difference_of_both_sides(unshared: float) -> None:
    mean, doubt = at_boundary(0.3, unshared)
    assert mean == pytest.approx(unshared, rel=1e-3)
    assert doubt == pytest.approx(0.3 * abs(unshared), rel=1e-2)


def test_the_finest_bit_has_no_room_and_noise_explains_a_little() -> None:
    assert at_boundary(0.3, 0.1, reach=1) == (0.0, 0.0)
    assert at_boundary(0.3, 0.1, reach=2)[0] == pytest.approx(0.1, rel=0.01)
    # Of eight pixels with sigmas of sqrt(2 v) / 100 each: 0.1 is 4 sigmas, half is believed.
    noise = (0.1 / 4.0 * 100.0) ** 2 * 8.0 / 2.0
    mean, doubt = at_boundary(0.3, 0.1, noise=noise)
    assert mean == pytest.approx(0.05, rel=0.01)
    assert doubt == pytest.approx(np.hypot(0.025, 0.3 * 0.05), rel=0.01)
