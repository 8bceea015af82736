"""Light section: a line of light swept over the scene, one image per stripe, or a laser's one line."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from pydantic import Field

from bodyscan.stripes.stripe_code import ImageKind, SequenceImages, StripeCode

if TYPE_CHECKING:
    from bodyscan.arrays import Array
    from bodyscan.stripes.stripe_limits import StripeLimits
    from bodyscan.stripes.stripe_map import StripeMap

STRIPE = ImageKind("stripe", "stripe{stripe:03d}", "stripe", max_count=1000)


class LightSection(StripeCode):
    """A swept line; most images are dark at any one pixel, so no dark image is needed."""

    kinds: ClassVar = (STRIPE,)
    uses_dark: ClassVar = False

    code: Literal["light-section"] = "light-section"
    stripes: Annotated[int, Field(ge=1, le=65535)]

    @property
    def image_counts(self) -> Mapping[ImageKind, int]:
        return {STRIPE: self.stripes}

    def intensity(self, kind: ImageKind, s: Array) -> Array:
        """Stripe i is lit in image i; see `StripeCode.intensity`."""
        import numpy as np

        return np.asarray(np.floor(s) == np.arange(self.stripes)[:, None], float)

    def decode(self, images: SequenceImages, limits: StripeLimits | None) -> StripeMap:
        from bodyscan.stripes.numbered_stripes import decode_line, decode_sweep

        if self.stripes == 1:
            return decode_line(images.lit, images.coded[STRIPE], self.direction)
        return decode_sweep(images.lit, images.coded[STRIPE], self.direction)


CODES = (LightSection,)
