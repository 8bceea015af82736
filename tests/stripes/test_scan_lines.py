"""Frames laid out as lines that cross the stripes: bits, differences and shares, with their noise."""

from __future__ import annotations

import numpy as np
import pytest

from bodyscan.arrays import Greys
from bodyscan.stripes.scan_lines import ScanLines, transpose

LEVELS = np.linspace(0.5, 9.0, 256, dtype=np.float32)
"""Variance of each grey level."""
SHAPE = (5, 7)


def frames(inverses: bool, of: type = np.uint8, direction: str = "vertical") -> ScanLines:
    rng = np.random.default_rng(0)
    lit: Greys = rng.integers(150, 250, SHAPE).astype(of)
    dark: Greys = rng.integers(0, 40, SHAPE).astype(of)
    patterns: Greys = rng.integers(0, 250, (3, *SHAPE)).astype(of)
    others: Greys = rng.integers(0, 250, (3, *SHAPE)).astype(of)
    return ScanLines.from_images(lit, dark, patterns, others if inverses else None, direction)


def test_horizontal_stripes_make_lines_of_columns() -> None:
    across, along = frames(True), frames(True, direction="horizontal")
    assert (across.transposed, along.transposed) == (False, True)
    assert np.array_equal(along.lit, across.lit.T)
    assert np.array_equal(along.dark, across.dark.T)
    assert along.inverses is not None
    assert across.inverses is not None
    for k in range(3):
        assert np.array_equal(along.patterns[k], across.patterns[k].T)
        assert np.array_equal(along.inverses[k], across.inverses[k].T)
    assert np.array_equal(transpose(across.patterns), along.patterns)
    assert frames(False, direction="horizontal").inverses is None


@pytest.mark.parametrize("of", [np.uint8, np.float32])
@pytest.mark.parametrize("inverses", [True, False])
def test_words_have_the_first_pattern_as_most_significant_bit(inverses: bool, of: type) -> None:
    images = frames(inverses, of)
    lit, dark = images.lit.astype(float), images.dark.astype(float)
    patterns = images.patterns.astype(float)
    middle = 0.5 * (lit + dark) if images.inverses is None else images.inverses.astype(float)
    bits = patterns > middle
    for k in range(3):
        assert np.array_equal(images.bright(k), bits[k])
    assert np.array_equal(images.words(), 4 * bits[0] + 2 * bits[1] + bits[2])
    np.testing.assert_array_equal(images.contrast, lit - dark)


@pytest.mark.parametrize("of", [np.uint8, np.float32])
@pytest.mark.parametrize("inverses", [True, False])
def test_differences_have_the_noise_of_frames_they_are_made_of(inverses: bool, of: type) -> None:
    images = frames(inverses, of)
    bit = np.array([2, 0])
    at = np.array([[3, 34, 1], [17, 2, 0]])
    value, noise = images.difference(bit, at, LEVELS)
    lit, dark = images.lit.ravel().astype(int), images.dark.ravel().astype(int)
    for k in range(2):
        pattern = images.patterns[bit[k]].ravel().astype(int)
        for n in range(3):
            here = at[k, n]
            if images.inverses is not None:
                inverse = images.inverses[bit[k]].ravel().astype(int)[here]
                expected = pattern[here] - inverse
                variance = LEVELS[pattern[here]] + LEVELS[inverse]
            else:
                # Twice what it is above the middle: 2 p - lit - dark.
                expected = 2 * pattern[here] - lit[here] - dark[here]
                variance = 4.0 * LEVELS[pattern[here]] + LEVELS[lit[here]] + LEVELS[dark[here]]
            assert value[k, n] == expected
            assert noise[k, n] == pytest.approx(np.sqrt(variance), rel=1e-5)


@pytest.mark.parametrize("of", [np.uint8, np.float32])
def test_a_share_is_the_difference_and_its_noise_over_all_light_in_128ths(of: type) -> None:
    images = frames(True, of)
    assert images.inverses is not None
    share = images.direct_share(1, LEVELS)
    pattern, inverse = (one[1].astype(int) for one in (images.patterns, images.inverses))
    noise = np.sqrt(LEVELS[pattern] + LEVELS[inverse])
    light = images.lit.astype(float) - images.dark
    expected = np.minimum(128.0 * (np.abs(pattern - inverse) + noise) / light, 255.0)
    assert np.abs(share.astype(float) - np.floor(expected)).max() <= 1.0
    assert np.median(share) < 255
