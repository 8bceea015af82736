"""Gray code: what is projected, and that it is read back."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from stripe_rendering import decode_gray

from bodyscan.errors import BadInput
from bodyscan.geometry.light_planes import Axis
from bodyscan.stripes.boundaries import bit_that_flips
from bodyscan.stripes.codes.gray import Gray, bits_needed
from bodyscan.stripes.gray.bit_words import gray_from_stripe, stripe_from_gray


@given(st.integers(2, 65535))
def test_code_words_are_turned_back_into_stripes(stripes: int) -> None:
    stripe = np.unique(np.linspace(0, stripes - 1, 50).astype(np.int64))
    gray = gray_from_stripe(stripe)
    assert gray.max() < 2 ** bits_needed(stripes)
    np.testing.assert_array_equal(stripe_from_gray(gray.astype(np.uint16)), stripe)


@given(st.integers(1, 65535))
def test_exactly_one_known_bit_flips_at_a_boundary(boundary: int) -> None:
    bits = 16
    before, behind = gray_from_stripe(np.array([boundary - 1, boundary])).tolist()
    flipped = f"{before ^ behind:016b}"
    assert flipped.count("1") == 1
    assert bit_that_flips(np.array([boundary]), bits)[0] == flipped.index("1")


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
    assert frames.shape == (bits_needed(stripes), 40, 41)
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


def test_stripes_narrower_than_a_projector_pixel_are_refused() -> None:
    with pytest.raises(BadInput, match="do not fit"):
        Gray(stripes=50, direction="vertical").pattern_images(width=49, height=100)


@pytest.mark.parametrize("direction", ["horizontal", "vertical"])
@pytest.mark.parametrize("with_dark", [True, False])
def test_projected_frames_seen_as_they_are_give_their_stripes(
    direction: Axis, with_dark: bool
) -> None:
    spec = Gray(stripes=40, direction=direction)
    patterns, inverses = np.split(spec.pattern_images(width=120, height=160) // 2 + 20, 2)
    lit = np.full((160, 120), 147, np.uint8)
    dark = np.full_like(lit, 20) if with_dark else None
    seen = decode_gray(lit, dark, patterns, inverses, stripes=40, direction=direction)
    pixel = np.arange(160 if direction == "horizontal" else 120)
    stripe_px = len(pixel) / 40
    true = (pixel + 0.5) / stripe_px
    true = np.broadcast_to(true[:, None] if direction == "horizontal" else true, lit.shape)
    assert np.isfinite(seen.s).mean() > 0.96  # all but a part of the outermost stripes
    # Unblurred boundaries between two pixels are known to half a pixel, and here exactly there.
    np.testing.assert_allclose(seen.s[np.isfinite(seen.s)], true[np.isfinite(seen.s)], atol=0.02)
    axis = 1 if direction == "horizontal" else 0
    np.testing.assert_allclose(
        seen.boundary_pixels[:, axis], seen.boundary_index * stripe_px - 0.5, atol=0.02
    )
    assert set(seen.boundary_index) == set(range(1, 40))
    assert seen.stripes == 40
    assert seen.lit is lit
    assert seen.s.dtype == seen.sigma.dtype == np.float32
    assert seen.boundary_index.dtype == np.int64
    assert seen.boundary_pixels.dtype == np.float64
