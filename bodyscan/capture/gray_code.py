"""The reflected binary code: stripe i is written as i ^ (i >> 1), most significant bit first.

From one stripe to the next exactly one bit flips, so a pixel at a boundary is never off by more
than the stripe next to it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def bits_needed(stripes: int) -> int:
    """Number of bits, and so of pattern frames, for this many stripes (>= 2)."""
    return (stripes - 1).bit_length()


def gray_from_stripe(stripe: NDArray[Any]) -> NDArray[Any]:
    """Code words of stripes (integers, any shape)."""
    return stripe ^ (stripe >> 1)


def stripe_from_gray(gray: NDArray[np.uint16]) -> NDArray[np.int32]:
    """Stripes of code words of up to 16 bits."""
    stripe = gray.copy()
    for shift in (1, 2, 4, 8):
        stripe ^= stripe >> shift
    return stripe.astype(np.int32)


def bit_that_flips(boundary: NDArray[np.int64], bits: int) -> NDArray[np.int64]:
    """Which bit (0 the most significant) flips at boundary i > 0, between stripes i - 1 and i."""
    lowest_set = np.frexp((boundary & -boundary).astype(np.float64))[1].astype(np.int64) - 1
    return bits - 1 - lowest_set
