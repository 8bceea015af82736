"""Gray and plain binary code: one image per bit, and one of each bit's inverse if wanted.

With inverses a boundary is the crossing of two curves, whether the surface is black or white;
without them, black must be known from a dark image.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from pydantic import Field

from bodyscan.files.model import Problem
from bodyscan.stripes.stripe_code import ImageKind, SequenceImages, StripeCode

if TYPE_CHECKING:
    from bodyscan.arrays import Array
    from bodyscan.stripes.gray.bit_words import WordCode
    from bodyscan.stripes.stripe_limits import StripeLimits
    from bodyscan.stripes.stripe_map import StripeMap

PATTERN = ImageKind("pattern", "bit{bit:02d}", "bit", max_count=16)
INVERSE = ImageKind("inverse", "bit{bit:02d}-inverse", "bit", max_count=16)
MAX_CODES = 1 << PATTERN.max_count


def count_bits(words: int) -> int:
    """Compute the number of bits, and so of patterns, for this many words (>= 2): ceil(log2(words))."""
    return max(1, (words - 1).bit_length())


class _NumberedStripes(StripeCode):
    """inverses: whether each pattern is also projected inverted.
    first_code: the number of stripe 0; the others count up from it.
    """

    kinds: ClassVar = (PATTERN, INVERSE)

    inverses: bool = True
    first_code: Annotated[int, Field(ge=0, lt=MAX_CODES)] = 0

    def problems(self) -> Iterator[Problem]:
        yield from super().problems()
        if self.first_code + self.stripes > MAX_CODES:
            highest = MAX_CODES - self.stripes
            wrong = (
                f"must be {highest} or less: {self.stripes} stripes from there need over 16 bits"
            )
            yield ("first_code",), f"{wrong} (got {self.first_code})"

    @property
    def bits(self) -> int:
        """Number of patterns."""
        return count_bits(self.first_code + self.stripes)

    @property
    @abstractmethod
    def word_code(self) -> WordCode:
        """How stripes are written in bits."""

    @property
    def needs_dark(self) -> bool:
        return not self.inverses

    @property
    def image_counts(self) -> Mapping[ImageKind, int]:
        inverse = {INVERSE: self.bits} if self.inverses else {}
        return {PATTERN: self.bits} | inverse

    @property
    def show_order(self) -> tuple[int, ...]:
        """The finest pattern in the middle, coarser ones alternately before and after it, inverses
        adjacent. As half of all boundaries are the finest's, motion does the least harm so."""
        finest_first = range(self.bits - 1, -1, -1)
        bits = (*finest_first[2::2][::-1], finest_first[0], *finest_first[1::2])
        if not self.inverses:
            return bits
        return tuple(image for bit in bits for image in (bit, self.bits + bit))

    def moment(self, times: Mapping[str, Array]) -> float:
        """The time of the finest pattern and its inverse, which show half of all boundaries."""
        finest = [float(each[-1]) for each in times.values()]
        return sum(finest) / len(finest)

    def intensity(self, kind: ImageKind, s: Array) -> Array:
        import numpy as np

        bright = self.word_code.bits(np.floor(s).astype(np.int64), self.bits)
        return bright if kind == PATTERN else 1.0 - bright

    def decode(self, images: SequenceImages, limits: StripeLimits | None) -> StripeMap:
        from bodyscan.stripes.gray.decoding import decode_bits, lay_out

        patterns, inverses = images.coded[PATTERN], images.coded.get(INVERSE)
        lines = lay_out(images.lit, images.dark, patterns, inverses, self.direction)
        return decode_bits(self.word_code, lines, images.lit, self.stripes, limits)


class Gray(_NumberedStripes):
    """The reflected binary code: one bit flips from stripe to stripe."""

    code: Literal["gray"] = "gray"

    @property
    def word_code(self) -> WordCode:
        from bodyscan.stripes.gray.bit_words import GRAY

        return replace(GRAY, first=self.first_code)


class Binary(_NumberedStripes):
    """The plain binary code."""

    code: Literal["binary"] = "binary"

    @property
    def word_code(self) -> WordCode:
        from bodyscan.stripes.gray.bit_words import BINARY

        return replace(BINARY, first=self.first_code)


CODES = (Gray, Binary)
