"""s where there are no boundaries: from a line fitted to the codes of the pixels around.

Where stripes are narrower than two pixels, or so blurred that noise flips the finest bits, the code
jumps by two or three from pixel to pixel, and a run of boundaries breaks at each jump. Codes are
still right to about a stripe, and a line through several of them is right to a fraction.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from bodyscan.arrays import Floats, Mask
from bodyscan.compiled import compiled

REACH_PX = 4
FEWEST, FEWEST_BESIDE = 6, 2
"""Pixels with a code in the window, and on each side of its middle: at a rim a line is
unreliable."""

LEAST_SLOPE = 0.35
"""Stripes per pixel: in wider stripes neighbours have the same code, and a line says nothing."""

WITHIN, MOST_WITHIN = 1.0, 2.0 / 3.0
"""Distance from the line in stripes, and the least share of pixels within it: correct codes are
within 0.5, misread ones hardly farther; of two surfaces one behind the other half are not."""

MAX_RMS = 1.2
"""Stripes: a wrong finest bit is off by one, the next by up to three."""

ROUNDING = 12.0**-0.5
"""Stripes: the standard deviation of s within a stripe."""


def fill_from_codes(s: Floats, sigma: Floats, codes: NDArray[np.int32], shown: Mask) -> None:
    """Write s and its standard deviation (L, P) into pixels that are `shown` and have none.

    A pixel whose own code is a stripe off the line of its neighbours gets none.
    """
    _fill(s, sigma, codes, shown)


@compiled
def _fill(s: Floats, sigma: Floats, codes: NDArray[np.int32], shown: Mask) -> None:
    for row in range(codes.shape[0]):
        for place in range(codes.shape[1]):
            if shown[row, place] and math.isnan(s[row, place]):
                off, doubt = _line_at(codes[row], shown[row], place)
                if doubt > 0.0:
                    s[row, place], sigma[row, place] = codes[row, place] + 0.5 + off, doubt


@compiled
def _line_at(codes: NDArray[np.int32], shown: Mask, middle: int) -> tuple[float, float]:
    """Offset, at a pixel, of the line through the codes (P,) around it from its own code, and the
    line's sigma there; sigma 0 if there is no line, or no jump that would break a run of
    boundaries."""
    first, last = max(middle - REACH_PX, 0), min(middle + REACH_PX, codes.size - 1)
    leaps, last_code = False, 0
    count, before, x1, y1, x2, xy, y2 = 0, 0, 0.0, 0.0, 0.0, 0.0, 0.0
    for place in range(first, last + 1):
        if shown[place]:
            leaps |= count > 0 and abs(codes[place] - last_code) > 1
            last_code = codes[place]
            x, y = float(place - middle), float(codes[place] - codes[middle])
            count, before = count + 1, before + (place < middle)
            x1, y1, x2, xy, y2 = x1 + x, y1 + y, x2 + x * x, xy + x * y, y2 + y * y
    if not leaps or count < FEWEST or before < FEWEST_BESIDE or count - before - 1 < FEWEST_BESIDE:
        return 0.0, 0.0
    spread = x2 - x1 * x1 / count
    both = xy - x1 * y1 / count
    slope = both / spread
    rms = math.sqrt(max(y2 - y1 * y1 / count - slope * both, 0.0) / (count - 2))
    off = (y1 - slope * x1) / count
    if abs(slope) < LEAST_SLOPE or rms > MAX_RMS or abs(off) >= 1.0:
        return 0.0, 0.0
    near = 0
    for place in range(first, last + 1):
        line = off + slope * (place - middle)
        near += shown[place] and abs(codes[place] - codes[middle] - line) < WITHIN
    if near < MOST_WITHIN * count:
        return 0.0, 0.0
    return off, max(rms, ROUNDING) * math.sqrt(1.0 / count + (x1 / count) ** 2 / spread)
