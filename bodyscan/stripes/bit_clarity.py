"""Which bits of a stripe sequence are seen clearly, pixel by pixel, and what that says of its frames.

Blur, bent grey levels, other surfaces' light and noise all weaken fine patterns more than coarse
ones. So where a fine bit is clear, every coarser one is, but for the few pixels at its own boundaries.
A pattern that is paired with another bit's inverse, or with the lit or the dark frame, is bright in
both or dark in both over half of the picture, whatever the exposure; that nothing else explains.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from bodyscan.arrays import Floats, Greys, Mask
from bodyscan.errors import DecodingFailed

CLEAR = 4.0
"""Sigmas of a pattern minus its inverse: noise alone does not get there."""

SEEN = 0.02
"""Of the pixels, those in which a pattern must be clear to be a pattern at all."""

STRONG, WEAK = 8.0, 0.25
"""A bit is weak where its difference is less than a quarter of a finer bit's, itself of 8 sigmas."""

MOST_WEAK, MOST_WEAK_FINE = 0.15, 0.35
"""Of the pixels where a finer bit is strong. Blurred stripes are as weak as that in a seventh (2 asin
(1/4) / pi) of their width beside their boundaries if they are the finest, coarser ones in half as
much; a wrong inverse makes it half."""
FINE_BITS = 3
MOST_BRIGHT = 0.85
"""Of the pixels; half of them would be bright under stripes that are fine."""
FEWEST = 200
ONE_SIDED = 0.25
"""Of the contrast: a dark or lit frame for an inverse makes half of it, drifting exposure a few
percent."""
SAME = 0.9
"""Of the pixels that are equal to the last bit: noise leaves a fifth of them so, a copy all."""
EVEN = 0.3
"""Between the quartiles of an even grey, in shares of the contrast; of black and white it is nearly 1.
Half of the light is a level of 0.5, or 0.73 if grey levels are bent."""


@dataclass(frozen=True, eq=False)
class LitPairs:
    """Patterns and inverses of pixels that the projector lights well, (bits, ...) each.

    value: pattern minus inverse, grey levels.  sigma: its standard deviation.
    """

    patterns: Greys
    inverses: Greys
    value: Floats
    sigma: Floats

    @staticmethod
    def of(patterns: Greys, inverses: Greys, variance: Floats) -> LitPairs:
        """Of images (bits, ...).  variance: (256,) of each grey level."""
        value = patterns.astype(np.float32) - inverses
        levels = (images.astype(np.uint8, copy=False) for images in (patterns, inverses))
        sigma = np.sqrt(sum(variance[level] for level in levels))
        return LitPairs(patterns, inverses, value, sigma)

    @property
    def clear(self) -> Mask:
        """(bits, ...): where noise did not decide."""
        return np.abs(self.value) >= CLEAR * self.sigma

    @property
    def coarse_clear(self) -> Mask:
        """(...): where noise decided none but the finest bits."""
        coarse = self.clear[: max(len(self.value) - FINE_BITS, 1)]
        return np.asarray(coarse.all(axis=0))

    def weak(self) -> Iterator[tuple[int, float]]:
        """Of each bit but the finest, in which share of pixels it is weaker than a finer one."""
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
    """Raises DecodingFailed for a bit that shows nowhere, or whose pattern is brighter than its inverse
    nearly everywhere though its stripes are fine.

    pairs: (bits, N).
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
    pattern that was taken for its own inverse is black and white, or the same to the last bit.
    """
    if np.mean(pairs.value[bit] == 0.0) > SAME:
        return False
    low = np.minimum(pairs.patterns, pairs.inverses).min(axis=0).astype(np.float32)
    high = np.maximum(pairs.patterns, pairs.inverses).max(axis=0)
    level = (pairs.patterns[bit] - low) / np.maximum(high - low, 1.0)
    first, middle, third = np.percentile(level, [25, 50, 75])
    return bool(third - first < EVEN and EVEN < middle < 1.0)


def check_pairs(pairs: LitPairs) -> None:
    """Raises DecodingFailed where a pattern and an inverse are not of one bit.  pairs: (bits, N)."""
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
    """Which inverse a pattern (N,) differs from most, if that is another bit's."""
    apart = np.abs(inverses.astype(np.float32) - pattern).mean(axis=1)
    other = int(apart.argmax())
    return f"pattern {bit} goes with inverse {other}" if other != bit else ""
