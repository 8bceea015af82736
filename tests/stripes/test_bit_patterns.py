"""Laying out bit patterns where exposure varied, and s from codes where stripes are too narrow."""

from __future__ import annotations

import numpy as np
import pytest

from bodyscan.errors import DecodingFailed
from bodyscan.stripes.gray.decoding import fill_from_codes, lay_out
from bodyscan.stripes.scan_lines import ScanLines

SHAPE = (40, 64)


def lines(
    contrast: int, *, off: int = 0, dark: int | None = 20, inverses: bool = True
) -> ScanLines:
    """Lit and dark, and four bits with inverses that are `off` grey levels brighter."""
    bits = (np.arange(64) >> np.arange(5, 1, -1)[:, None]) & 1
    on, below = 20 + contrast + off, 20 + off
    pattern = np.where(bits == 1, on, below).astype(np.uint8)[:, None].repeat(SHAPE[0], axis=1)
    inverse = np.where(bits == 0, on, below).astype(np.uint8)[:, None].repeat(SHAPE[0], axis=1)
    lit = np.full(SHAPE, 20 + contrast, np.uint8)
    black = None if dark is None else np.full(SHAPE, dark, np.uint8)
    return lay_out(lit, black, pattern, inverse if inverses else None, "vertical")


@pytest.mark.parametrize(
    ("contrast", "off", "alike"),
    [
        (100, 0, True), (100, 16, True), (100, 17, False), (40, 8, True), (40, 9, False),
        # Eight levels, of lit and dark together, are noise whatever the contrast.
        (4, 0, True), (4, 4, True), (4, 5, False),
    ],
)  # fmt: skip
def test_frames_off_by_a_quarter_of_the_contrast_beyond_noise_were_exposed_otherwise(
    contrast: int, off: int, alike: bool
) -> None:
    found = lines(contrast, off=off)
    assert found.lit.min() == 20 + contrast + (0 if alike else off)
    assert found.dark.max() == 20 + (0 if alike else off)


def test_without_a_dark_frame_the_darker_of_each_two_is_black() -> None:
    assert set(lines(100, dark=None).dark.ravel().tolist()) == {20}
    with pytest.raises(DecodingFailed, match="what black is"):
        lines(100, dark=None, inverses=False)


PLACES = np.arange(60)


def filled(
    codes: np.ndarray, shown: np.ndarray | None = None, s: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """s and sigma (60,) of one line."""
    found = np.full((1, len(codes)), np.nan, np.float32) if s is None else s[None].copy()
    sigma = np.full_like(found, np.nan)
    every = np.ones(len(codes), bool) if shown is None else shown
    fill_from_codes(found, sigma, codes[None].astype(np.int32), every[None])
    return found[0], sigma[0]


@pytest.mark.parametrize("slope", [1.3, -1.7, 2.6])
def test_s_lies_on_the_line_through_jumping_codes(slope: float) -> None:
    s = 170.3 + slope * PLACES
    found, sigma = filled(np.floor(s))
    known = np.isfinite(found)
    assert known[4:-4].mean() > 0.9
    # Nine codes, each known to 1/sqrt(12) of a stripe: a third of that.
    off = (found - s)[known]
    assert np.sqrt(np.mean(off**2)) < 12.0**-0.5 / 3.0 * 1.2
    assert sigma[10:50][known[10:50]].min() == pytest.approx(12.0**-0.5 / 3.0, rel=0.05)
    assert np.abs(off / sigma[known]).max() < 3.0


def test_beside_a_rim_two_pixels_on_either_side_must_show_a_code() -> None:
    s = 20.3 + 1.7 * PLACES
    shown = (PLACES >= 10) & (PLACES <= 40)
    found, sigma = filled(np.floor(s), shown)
    assert np.flatnonzero(np.isfinite(found)).tolist() == list(range(12, 39))
    # With nine, eight and seven in the window, which is lopsided then.
    assert sigma[14] < sigma[13] < sigma[12]
    x = np.arange(-2, 5)
    doubt = np.sqrt((1.0 / 7.0 + np.mean(x) ** 2 / np.sum((x - np.mean(x)) ** 2)) / 12.0)
    assert sigma[12] == pytest.approx(doubt, rel=0.1)


def test_unusable_and_known_pixels_are_left() -> None:
    s = 20.3 + 1.7 * PLACES
    shown = PLACES != 30
    known = np.full(60, np.nan, np.float32)
    known[35] = 7.0
    found, sigma = filled(np.floor(s), shown, known)
    assert np.isnan(found[30])
    assert found[35] == 7.0
    assert np.isnan(sigma[35])
    assert np.isfinite(found[[29, 31, 34, 36]]).all()


def test_codes_without_jumps_are_left_to_boundaries() -> None:
    assert np.isnan(filled(np.floor(20.3 + 0.9 * PLACES))[0]).all()
    assert np.isnan(filled(np.full(60, 7))[0]).all()


def test_a_code_a_stripe_off_the_line_of_its_neighbours_is_misread() -> None:
    codes = np.floor(20.3 + 1.7 * PLACES)
    codes[30] += 2
    found, _ = filled(codes)
    assert np.isnan(found[30])
    assert np.isfinite(found[[28, 29, 31, 32]]).all()


def test_scattered_codes_and_two_surfaces_give_no_line() -> None:
    rng = np.random.default_rng(0)
    assert np.isnan(filled(np.floor(20.3 + 1.7 * PLACES) + rng.integers(-4, 5, 60))[0]).mean() > 0.9
    # One in front of the other, pixel by pixel, 2.4 stripes apart: half lie beside the line.
    two = np.floor(40.3 + 0.6 * PLACES) + np.where(PLACES % 4 < 2, 0.0, 2.4)
    assert np.isnan(filled(np.floor(two))[0]).mean() > 0.8
    # Leaps, but no slope: a line says nothing.
    level = np.where(PLACES % 3 == 0, 22, 20)
    assert np.isnan(filled(level)[0]).all()
