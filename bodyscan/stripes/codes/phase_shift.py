"""Phase shift: waves of light, shifted from image to image, and a Gray code of half periods.

The phase tells s to a period; which period it is, the Gray code tells.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from pydantic import Field

from bodyscan.files.model import Problem
from bodyscan.stripes.codes.gray import INVERSE, PATTERN, bits_needed
from bodyscan.stripes.stripe_code import ImageKind, SequenceImages, StripeCode

if TYPE_CHECKING:
    from bodyscan.arrays import Array
    from bodyscan.stripes.stripe_limits import StripeLimits
    from bodyscan.stripes.stripe_map import StripeMap

PHASE = ImageKind("phase", "phase{step:02d}", "step", most=64)


class PhaseShift(StripeCode):
    """inverses: of the Gray code.  steps: images in one period.  period: stripes in it."""

    kinds: ClassVar = (PATTERN, INVERSE, PHASE)
    has_edges: ClassVar = False

    code: Literal["phase-shift"] = "phase-shift"
    inverses: bool = True
    steps: Annotated[int, Field(ge=3, le=64)] = 4
    period: Annotated[int, Field(ge=2, le=65535)] = 8

    def problems(self) -> Iterator[Problem]:
        yield from super().problems()
        if self.period > self.stripes:
            wrong = f"must be {self.stripes} (stripes) or less (got {self.period})"
            yield ("period",), wrong

    @property
    def half_periods(self) -> int:
        """How many the stripes make, the last one perhaps in part."""
        return -(-2 * self.stripes // self.period)

    @property
    def needs_lit(self) -> bool:
        return not self.inverses

    @property
    def needs_dark(self) -> bool:
        return not self.inverses

    @property
    def image_counts(self) -> Mapping[ImageKind, int]:
        bits = bits_needed(self.half_periods)
        inverse = {INVERSE: bits} if self.inverses else {}
        return {PATTERN: bits} | inverse | {PHASE: self.steps}

    def intensity(self, kind: ImageKind, s: Array) -> Array:
        import numpy as np

        from bodyscan.stripes.bit_words import GRAY

        turns = s / self.period
        if kind == PHASE:
            shift = np.arange(self.steps)[:, None] / self.steps
            return 0.5 + 0.5 * np.cos(2.0 * np.pi * (turns - shift))
        halves = np.floor(s * (2.0 / self.period)).astype(np.int64)
        bright = GRAY.bits(halves, bits_needed(self.half_periods))
        return bright if kind == PATTERN else 1.0 - bright

    def decode(self, images: SequenceImages, limits: StripeLimits | None) -> StripeMap:
        from bodyscan.stripes.bit_patterns import bit_lines
        from bodyscan.stripes.phase_steps import decode_phase

        patterns, inverses = images.coded[PATTERN], images.coded.get(INVERSE)
        lines = bit_lines(images.lit, images.dark, patterns, inverses, self.direction)
        waves = images.coded[PHASE]
        return decode_phase(lines, images.lit, waves, self.half_periods, self.period, self.stripes)


CODES = (PhaseShift,)
