"""Stripe numbers as binary words, most significant bit first: reflected (Gray) and plain code."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bodyscan.arrays import Array, Indices


def gray_from_stripe(stripe: NDArray[Any]) -> NDArray[Any]:
    """Gray code words i ^ (i >> 1) of stripes (integers, any shape); neighbours differ in one bit."""
    return stripe ^ (stripe >> 1)


def stripe_from_gray(gray: NDArray[np.uint16]) -> NDArray[np.int32]:
    """Stripes of Gray code words of up to 16 bits."""
    stripe = gray.copy()
    for shift in (1, 2, 4, 8):
        stripe ^= stripe >> shift
    return stripe.astype(np.int32)


@dataclass(frozen=True)
class WordCode:
    """Conversion between stripe numbers and code words."""

    encode: Callable[[NDArray[Any]], NDArray[Any]]
    decode: Callable[[NDArray[np.uint16]], NDArray[np.int32]]
    single: bool  # whether the words of neighbouring stripes differ in one bit
    # Added to the sigma of boundaries where the finest stripes are one wide and blur into each
    # other (measured on synthetic images).
    blur_sigma_px: float
    first: int = 0  # the number of stripe 0

    def stripes(self, words: NDArray[np.uint16]) -> NDArray[np.int32]:
        """Stripes of code words; negative for words before the first."""
        numbers = self.decode(words)
        return numbers - np.int32(self.first) if self.first else numbers

    def bits(self, stripes: Indices, count: int) -> Array:
        """Bits (count, N), 1 or 0, of stripes (N,), the most significant first."""
        shift = np.arange(count)[::-1, None]
        return np.asarray(self.encode(stripes + self.first) >> shift & 1, float)

    def bit_two_wide(self, bits: int) -> int:
        """The bit whose stripes are two wide: Gray code's finest, the plain code's next to finest."""
        return bits - 1 if self.single else max(bits - 2, 0)


GRAY = WordCode(gray_from_stripe, stripe_from_gray, single=True, blur_sigma_px=0.0)
BINARY = WordCode(
    lambda numbers: numbers, lambda words: words.astype(np.int32), single=False, blur_sigma_px=0.04
)
