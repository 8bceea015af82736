"""Phase shift: waves of light, shifted from image to image.

A wave's phase gives s within a period. Which period it is, the other waves show, or, with a single
wave, a Gray code of half periods.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from pydantic import Field

from bodyscan.files.model import Problem
from bodyscan.stripes.codes.gray import INVERSE, PATTERN, count_bits
from bodyscan.stripes.stripe_code import ImageKind, SequenceImages, Shift, StripeCode, Wave

if TYPE_CHECKING:
    from bodyscan.arrays import Array, Greys
    from bodyscan.stripes.stripe_limits import StripeLimits
    from bodyscan.stripes.stripe_map import StripeMap

PHASE = ImageKind("phase", "phase{step:02d}", "step", max_count=256)

Steps = Annotated[int, Field(ge=3, le=64)]
Period = Annotated[float, Field(ge=2, le=1e6)]
Count = Annotated[float, Field(gt=0, le=65535)]


class PhaseShift(StripeCode):
    """One wave or several, given by their periods.

    period: stripes per period of each wave; alternatively periods: how many the stripes make.
    steps: images of each wave. shift: which way waves move from image to image.
    start_deg: the phase, degrees, at `origin` (stripes) in image 0.
    inverses: whether to show those of the Gray code, which exists for a single wave that repeats.
    """

    kinds: ClassVar = (PATTERN, INVERSE, PHASE)
    has_edges: ClassVar = False

    code: Literal["phase-shift"] = "phase-shift"
    inverses: bool = True
    steps: Steps | Annotated[tuple[Steps, ...], Field(min_length=1, max_length=8)] = 4
    period: Period | Annotated[tuple[Period, ...], Field(min_length=1, max_length=8)] | None = None
    periods: Count | Annotated[tuple[Count, ...], Field(min_length=1, max_length=8)] | None = None
    shift: Shift = "forward"
    start_deg: Annotated[float, Field(ge=-360, le=360)] = 0.0
    origin: Annotated[float, Field(ge=-65535, le=65535)] = 0.0

    def problems(self) -> Iterator[Problem]:
        yield from super().problems()
        if self.period is not None and self.periods is not None:
            yield ("periods",), "repeats what period gives: give one of the two"
            return
        lengths = self._lengths
        if isinstance(self.steps, tuple) and len(self.steps) != len(lengths):
            wrong = f"has {len(self.steps)} numbers, but there are {len(lengths)} waves"
            yield ("steps",), wrong
            return
        key = "period" if self.periods is None else "periods"
        if self.needs_gray:
            if lengths[0] < 2.0:
                yield (key,), f"gives waves of {lengths[0]:g} stripes: a period has 2 or more"
            return
        if len(lengths) == 1 and lengths[0] > self.stripes and key == "period":
            wrong = f"must be {self.stripes} (stripes) or less (got {lengths[0]:g})"
            yield (key,), wrong
            return
        again = find_repetition(lengths, self.stripes)
        if again is not None:
            all_periods = ", ".join(f"{length:g}" for length in lengths)
            yield (
                (key,),
                f"does not distinguish all stripes: waves of {all_periods} stripes repeat after"
                f" {again:g} of {self.stripes}; one must cover all of them, or their beat",
            )

    @property
    def _lengths(self) -> tuple[float, ...]:
        """Stripes per period of each wave."""
        if self.periods is not None:
            counts = self.periods if isinstance(self.periods, tuple) else (self.periods,)
            return tuple(self.stripes / count for count in counts)
        if self.period is None:
            return (min(8.0, float(self.stripes)),)
        return self.period if isinstance(self.period, tuple) else (self.period,)

    @property
    def waves(self) -> tuple[Wave, ...]:
        """The waves in the order of their images."""
        lengths = self._lengths
        steps = self.steps if isinstance(self.steps, tuple) else (self.steps,) * len(lengths)
        start = math.radians(self.start_deg)
        return tuple(
            Wave(length, count, self.shift, start, self.origin)
            for length, count in zip(lengths, steps, strict=True)
        )

    @property
    def needs_gray(self) -> bool:
        """Whether a Gray code says which period it is."""
        lengths = self._lengths
        return len(lengths) == 1 and lengths[0] < self.stripes

    @property
    def half_periods(self) -> int:
        """Number of half periods of the single wave, the last one perhaps incomplete."""
        return math.ceil(2.0 * self.stripes / self._lengths[0] - 1e-9)

    @property
    def needs_dark(self) -> bool:
        return self.needs_gray and not self.inverses

    @property
    def image_counts(self) -> Mapping[ImageKind, int]:
        phases = {PHASE: sum(wave.steps for wave in self.waves)}
        if not self.needs_gray:
            return phases
        bits = count_bits(self.half_periods)
        inverse = {INVERSE: bits} if self.inverses else {}
        return {PATTERN: bits} | inverse | phases

    def lit_from(self, coded: Mapping[ImageKind, Greys]) -> Greys:
        if self.needs_gray:
            return super().lit_from(coded)
        from bodyscan.stripes.phase.waves import estimate_white_image

        return estimate_white_image(coded[PHASE], self.waves)

    def intensity(self, kind: ImageKind, s: Array) -> Array:
        import numpy as np

        from bodyscan.stripes.gray.bit_words import GRAY

        if kind == PHASE:
            return np.concatenate([
                0.5 + 0.5 * np.cos(2.0 * np.pi * (
                    (s - wave.origin) / wave.period
                    - wave.sign * np.arange(wave.steps)[:, None] / wave.steps
                ) + wave.start)
                for wave in self.waves
            ])  # fmt: skip
        halves = np.floor(s * (2.0 / self._lengths[0])).astype(np.int64)
        bright = GRAY.bits(halves, count_bits(self.half_periods))
        return bright if kind == PATTERN else 1.0 - bright

    def decode(self, images: SequenceImages, limits: StripeLimits | None) -> StripeMap:
        from bodyscan.stripes.gray.decoding import lay_out
        from bodyscan.stripes.phase.decoding import decode_wave, decode_waves

        phases = images.coded[PHASE]
        if not self.needs_gray:
            return decode_waves(phases, self.waves, images.lit, self.direction, self.stripes)
        patterns, inverses = images.coded[PATTERN], images.coded.get(INVERSE)
        lines = lay_out(images.lit, images.dark, patterns, inverses, self.direction)
        (wave,) = self.waves
        return decode_wave(lines, images.lit, phases, self.half_periods, wave, self.stripes)


def find_repetition(periods: tuple[float, ...], stripes: int, bound: float = 0.004) -> float | None:
    """Find by how many stripes s can move, fewer than `stripes`, without any wave changing by as
    much as `bound` of its period (8 times the minimum sigma of a phase, so that an order can be found
    at all); None if the waves determine s."""
    finest = min(periods)
    for moved in (count * finest for count in range(1, int(stripes / finest) + 1)):
        if all(abs(moved / period - round(moved / period)) < bound for period in periods):
            return moved if moved < stripes else None
    return None


CODES = (PhaseShift,)
