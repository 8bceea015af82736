"""The stripe-index image: luminance 1 to 254 is the stripe's number, 0 and 255 mean none.

It is the output of instruments like the chapter's (4.1, Fig. 5), which project their own stripes.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, ClassVar, Literal

from bodyscan.errors import BadInput
from bodyscan.files.model import Problem
from bodyscan.stripes.stripe_code import ImageKind, SequenceImages, StripeCode

if TYPE_CHECKING:
    from bodyscan.arrays import Array
    from bodyscan.stripes.stripe_limits import StripeLimits
    from bodyscan.stripes.stripe_map import StripeMap

INDEX = ImageKind("index", "index")


class StripeIndex(StripeCode):
    """Stripe numbers in one image; boards are looked for in the lit image, without stripes."""

    kinds: ClassVar = (INDEX,)
    uses_dark: ClassVar = False
    is_projected: ClassVar = False
    has_edges: ClassVar = False

    code: Literal["stripe-index"] = "stripe-index"

    def problems(self) -> Iterator[Problem]:
        yield from super().problems()
        if self.stripes > 254:
            wrong = f"must be 254 or less for stripe-index (got {self.stripes})"
            yield ("stripes",), wrong

    @property
    def image_counts(self) -> Mapping[ImageKind, int]:
        return {INDEX: 1}

    def intensity(self, kind: ImageKind, s: Array) -> Array:
        """Raises BadInput: there is nothing to project."""
        raise BadInput(
            "a stripe-index image is the output of an instrument that projects its stripes itself",
            remedy="choose another code for a projector that shows images",
        )

    def decode(self, images: SequenceImages, limits: StripeLimits | None) -> StripeMap:
        from bodyscan.stripes.numbered_stripes import decode_index

        return decode_index(images.lit, images.coded[INDEX], self.direction, self.stripes)


CODES = (StripeIndex,)
