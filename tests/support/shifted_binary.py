"""A stripe code that bodyscan does not have: plain binary numbers that begin at `first`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from pydantic import Field

from bodyscan.stripes.stripe_code import ImageKind, SequenceImages, StripeCode

if TYPE_CHECKING:
    from bodyscan.arrays import Array
    from bodyscan.stripes.stripe_limits import StripeLimits
    from bodyscan.stripes.stripe_map import StripeMap

DIGIT = ImageKind("digit", "digit{digit:02d}", "digit", max_count=16)


class ShiftedBinary(StripeCode):
    """first: the number of stripe 0."""

    kinds: ClassVar = (DIGIT,)

    code: Literal["shifted-binary"] = "shifted-binary"
    first: Annotated[int, Field(ge=0, le=1000)] = 5

    @property
    def needs_dark(self) -> bool:
        return True

    @property
    def image_counts(self) -> Mapping[ImageKind, int]:
        return {DIGIT: (self.first + self.stripes - 1).bit_length()}

    def intensity(self, kind: ImageKind, s: Array) -> Array:
        import numpy as np

        number = np.floor(s).astype(int) + self.first
        digit = np.arange(self.image_counts[kind])[::-1, None]
        return (number >> digit & 1).astype(float)

    def decode(self, images: SequenceImages, limits: StripeLimits | None) -> StripeMap:
        import numpy as np

        from bodyscan.stripes.numbered_stripes import decode_index

        digits = images.coded[DIGIT]
        middle = (images.lit.astype(float) + images.dark) / 2
        number = np.zeros(images.lit.shape, int)
        for digit in digits:
            number = 2 * number + (digit > middle)
        index = np.clip(number - self.first + 1, 0, 255).astype(np.uint8)
        return decode_index(images.lit, index[None], self.direction, self.stripes)


CODES = (ShiftedBinary,)
