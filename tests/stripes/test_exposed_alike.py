"""Whether frames of a sequence were exposed as lit and dark were; where not, patterns tell both."""

from __future__ import annotations

import numpy as np
import pytest

from bodyscan.errors import DecodingFailed
from bodyscan.stripes.gray.bit_patterns import lay_out
from bodyscan.stripes.scan_lines import ScanLines

SHAPE = (40, 64)


def lines(
    contrast: int, *, off: int = 0, dark: int | None = 20, coarse: int = 0, inverses: bool = True
) -> ScanLines:
    """Lit and dark, and four bits with inverses that are `off` grey levels brighter; but for so many
    of the coarse ones, which are as they should be."""
    bits = (np.arange(64) >> np.arange(5, 1, -1)[:, None]) & 1
    more = np.where(np.arange(4) < coarse, 0, off)[:, None]
    on, below = 20 + contrast + more, 20 + more
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


def test_one_of_the_three_coarsest_bits_is_enough() -> None:
    assert lines(100, off=60, coarse=1).dark.max() == 20
    assert lines(100, off=60, coarse=0).dark.max() == 80


def test_without_a_dark_frame_the_darker_of_each_two_is_black() -> None:
    assert set(lines(100, dark=None).dark.ravel().tolist()) == {20}
    with pytest.raises(DecodingFailed, match="what black is"):
        lines(100, dark=None, inverses=False)
