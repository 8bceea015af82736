"""Stripes where other surfaces throw light too: dropped where that is most of the light."""

from __future__ import annotations

import numpy as np
import pytest
from stripe_rendering import Sequence, decode_gray, gray_bits, render_sequence

from bodyscan.arrays import Floats
from bodyscan.stripes import usable_pixels
from bodyscan.stripes.scan_lines import ScanLines
from bodyscan.stripes.stripe_map import StripeMap
from bodyscan.stripes.usable_pixels import find_direct_pixels

STRIPES, PX = 50, 4.0
THERE = slice(12, 31)
"""Stripes on the surface that throws light back: its share of a bit is that of these."""
DIRECT = 180.0


def is_shadowed(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    return np.where((u > 100) & (u < 160), np.nan, 2.0 + u / PX * 0.7 + 0.02 * v)


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
