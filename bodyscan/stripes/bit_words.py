"""Stripes as binary words, most significant bit first: reflected (Gray) and plain code.

Gray code writes stripe i as i ^ (i >> 1). From one stripe to the next exactly one bit flips, so a
pixel at a boundary is never off by more than one stripe. The plain code writes i itself.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bodyscan.arrays import Array, Indices


def gray_from_stripe(stripe: NDArray[Any]) -> NDArray[Any]:
    """Code words of stripes (integers, any shape)."""
    return stripe ^ (stripe >> 1)


def stripe_from_gray(gray: NDArray[np.uint16]) -> NDArray[np.int32]:
    """Stripes of code words of up to 16 bits."""
    stripe = gray.copy()
    for shift in (1, 2, 4, 8):
        stripe ^= stripe >> shift
    return stripe.astype(np.int32)


def bit_that_flips(boundary: Indices, bits: int) -> Indices:
    """Which bit (0 the most significant) flips at boundary i > 0, between numbers i - 1 and i.

    In the plain code, where several flip, the coarsest of them.
    """
    lowest_set = np.frexp((boundary & -boundary).astype(np.float64))[1].astype(np.int64) - 1
    return bits - 1 - lowest_set


@dataclass(frozen=True)
class WordCode:
    """How stripes are written as words, and words read.

    encode, decode: numbers to words and back.
    single: whether neighbours differ in one bit.
    doubt_px: added to the sigma of boundaries if the finest pattern's stripes are one wide instead
        of two, and blur into each other (found in tests).
    first: the number of stripe 0.
    """

    encode: Callable[[NDArray[Any]], NDArray[Any]]
    decode: Callable[[NDArray[np.uint16]], NDArray[np.int32]]
    single: bool
    doubt_px: float
    first: int = 0

    def stripes(self, words: NDArray[np.uint16]) -> NDArray[np.int32]:
        """Stripes of code words; negative for words before the first."""
        numbers = self.decode(words)
        return numbers - np.int32(self.first) if self.first else numbers

    def bits(self, stripes: Indices, count: int) -> Array:
        """Bits (count, N), 1 or 0, of stripes (N,), the most significant first."""
        shift = np.arange(count)[::-1, None]
        return np.asarray(self.encode(stripes + self.first) >> shift & 1, float)

    @property
    def finest_run(self) -> int:
        """Width of the finest pattern's stripes, in stripes."""
        return 2 if self.single else 1

    def two_wide(self, bits: int) -> int:
        """The bit whose stripes are two wide: Gray code's
        finest, the plain code's next to finest."""
        return bits - 1 if self.single else max(bits - 2, 0)


def _as_it_is(numbers: NDArray[Any]) -> NDArray[Any]:
    return numbers


def _as_stripes(words: NDArray[np.uint16]) -> NDArray[np.int32]:
    return words.astype(np.int32)


GRAY = WordCode(gray_from_stripe, stripe_from_gray, single=True, doubt_px=0.0)
BINARY = WordCode(_as_it_is, _as_stripes, single=False, doubt_px=0.04)
