"""Which bits of a stripe sequence are clear at each pixel, and what that says about its frames.

Blur, non-linear grey levels, light from other surfaces and noise all weaken fine patterns more than
coarse ones. Where a fine bit is clear, so is every coarser one, except for the few pixels at its
own boundaries. A pattern that is paired with another bit's inverse, or with the lit or the dark
frame, is bright in both or dark in both over half of the image, whatever the exposure; nothing else
does that.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from bodyscan.arrays import Floats, Greys, Mask
from bodyscan.errors import DecodingFailed

CLEAR = 4.0
"""Sigmas of a pattern minus its inverse: out of reach of noise alone."""

SEEN = 0.02
"""Share of the pixels in which a pattern must be clear to be a pattern at all."""

STRONG, WEAK = 8.0, 0.25
"""A bit is weak if its difference is less than a quarter of a finer bit's of at least 8 sigmas."""

MOST_WEAK, MOST_WEAK_FINE = 0.15, 0.35
"""Shares of the pixels where a finer bit is strong. Blurred stripes of the finest bit are that weak
in a seventh (2 asin(1/4) / pi) of their width, next to their boundaries; coarser ones in half as
much. A wrong inverse makes it half."""
FINE_BITS = 3
MOST_BRIGHT = 0.85
"""Share of the pixels; under fine stripes half of them would be bright."""
FEWEST = 200
ONE_SIDED = 0.25
"""Share of the contrast: a dark or lit frame in place of an inverse gives half of it, drifting
exposure a few percent."""
SAME = 0.9
"""Share of the pixels that are exactly equal: noise leaves a fifth of them so, a copy all."""
EVEN = 0.3
"""Distance between the quartiles of an even grey, as a share of the contrast; for black and white
it is nearly 1. Half of the light is a level of 0.5, or 0.73 if grey levels are non-linear."""


@dataclass(frozen=True, eq=False)
class LitPairs:
    """Patterns and inverses of pixels that the projector lights well, (bits, ...) each.

    value: pattern minus inverse, grey levels.
    sigma: its standard deviation.
    """

    patterns: Greys
    inverses: Greys
    value: Floats
    sigma: Floats

    @staticmethod
    def of(patterns: Greys, inverses: Greys, variance: Floats) -> LitPairs:
        """From images (bits, ...). variance: (256,) of each grey level."""
        value = patterns.astype(np.float32) - inverses
        levels = (images.astype(np.uint8, copy=False) for images in (patterns, inverses))
        sigma = np.sqrt(sum(variance[level] for level in levels))
        return LitPairs(patterns, inverses, value, sigma)

    @property
    def clear(self) -> Mask:
        """Where noise did not decide the bit, (bits, ...)."""
        return np.abs(self.value) >= CLEAR * self.sigma

    @property
    def coarse_clear(self) -> Mask:
        """Where noise decided none but the finest bits, (...)."""
        coarse = self.clear[: max(len(self.value) - FINE_BITS, 1)]
        return np.asarray(coarse.all(axis=0))

    def weak(self) -> Iterator[tuple[int, float]]:
        """For each bit but the finest, the share of pixels in
        which it is weaker than a finer one."""
        size = np.abs(self.value)
        finer, strong = size[-1], size[-1] >= STRONG * self.sigma[-1]
        found = []
        for bit in range(len(size) - 2, -1, -1):
            if np.count_nonzero(strong) >= FEWEST:
                found.append((bit, float(np.mean(size[bit][strong] < WEAK * finer[strong]))))
            finer = np.maximum(finer, size[bit])
            strong = strong | (size[bit] >= STRONG * self.sigma[bit])
        yield from reversed(found)


def check_seen(pairs: LitPairs) -> None:
    """Check that every bit shows, and that no fine pattern is brighter than its inverse nearly
    everywhere.

    pairs: (bits, N).

    Raises DecodingFailed.
    """
    clear = pairs.clear
    if clear.shape[1] < FEWEST:
        return
    for bit, share in enumerate(clear.mean(axis=1)):
        if share < SEEN and not (bit >= len(clear) - FINE_BITS and _blurred_away(pairs, bit)):
            raise DecodingFailed(
                f"pattern and inverse of bit {bit} look alike: the bit shows in {share:.1%} of the lit "
                "pixels",
                remedy="see whether one of the two is missing or was taken twice; if the stripes are "
                "finer than camera or projector can show, leave the finest bit out (half the stripes)",
            )
    finest = len(clear) - 1
    size = np.abs(pairs.value)
    strong = np.median(size[finest]) > ONE_SIDED * np.median(size.max(axis=0))
    bright = np.mean(pairs.value[finest] > 0)
    coarser = np.mean(pairs.value[max(finest - FINE_BITS, 0)] > 0)
    balanced = MOST_BRIGHT > coarser > 1.0 - MOST_BRIGHT
    if strong and balanced and not MOST_BRIGHT > bright > 1.0 - MOST_BRIGHT:
        which = "brighter" if bright > 0.5 else "darker"
        raise DecodingFailed(
            f"pattern {finest} is {which} than its inverse nearly everywhere, though it is the finest",
            remedy="see whether one of the two is missing, or another image stands in for it",
        )


def _blurred_away(pairs: LitPairs, bit: int) -> bool:
    """Whether a pattern is an even grey between the darkest and the brightest that each pixel sees.

    Then projector or lens could not show its stripes, and the pixels are judged one by one; a
    pattern used as its own inverse is black and white, or exactly equal to it.
    """
    if np.mean(pairs.value[bit] == 0.0) > SAME:
        return False
    low = np.minimum(pairs.patterns, pairs.inverses).min(axis=0).astype(np.float32)
    high = np.maximum(pairs.patterns, pairs.inverses).max(axis=0)
    level = (pairs.patterns[bit] - low) / np.maximum(high - low, 1.0)
    first, middle, third = np.percentile(level, [25, 50, 75])
    return bool(third - first < EVEN and EVEN < middle < 1.0)


def check_pairs(pairs: LitPairs) -> None:
    """Raises DecodingFailed if a pattern and an inverse are not of one bit. pairs: (bits, N)."""
    bits = len(pairs.value)
    wrong = [
        (bit, share)
        for bit, share in pairs.weak()
        if share > (MOST_WEAK if bit < bits - FINE_BITS else MOST_WEAK_FINE)
    ]
    if wrong:
        named = ", ".join(f"{bit} ({share:.0%} of the pixels)" for bit, share in wrong)
        paired = [_partner(pairs.patterns[bit], pairs.inverses, bit) for bit, _ in wrong]
        said = "; ".join(filter(None, paired))
        raise DecodingFailed(
            f"pattern and inverse look alike where finer ones differ clearly: bit {named}",
            remedy="see whether a frame is missing, so that those behind it moved up, or stands in "
            "another's place" + (f" ({said})" if said else ""),
        )


def _partner(pattern: Greys, inverses: Greys, bit: int) -> str:
    """The inverse from which a pattern (N,) differs most, in words, if that is another bit's."""
    apart = np.abs(inverses.astype(np.float32) - pattern).mean(axis=1)
    other = int(apart.argmax())
    return f"pattern {bit} goes with inverse {other}" if other != bit else ""
