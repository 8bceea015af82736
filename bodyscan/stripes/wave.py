"""One wave of light as a phase-shift code projects it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Shift = Literal["forward", "backward"]


@dataclass(frozen=True)
class Wave:
    """Image k of `steps` shows 1/2 + 1/2 cos(2 pi ((s - origin) / period -+ k / steps) + start).

    period, origin: stripes.
    start: radians.
    shift: forward if the wave moves to larger s from image to image (the sign before k is minus),
        backward if it moves to smaller s.
    """

    period: float
    steps: int
    shift: Shift = "forward"
    start: float = 0.0
    origin: float = 0.0

    @property
    def sign(self) -> float:
        """Sign of the shift: 1 forward."""
        return 1.0 if self.shift == "forward" else -1.0

    @property
    def first_turn(self) -> float:
        """s / period where image 0 is brightest, modulo 1."""
        return (self.origin / self.period - self.start / 6.283185307179586) % 1.0


def alike_again(periods: tuple[float, ...], stripes: int, least: float) -> float | None:
    """By how many stripes s can move (less than `stripes`) without any wave changing by as much as
    `least` of its period; None if it cannot, in which case the waves determine s."""
    finest = min(periods)
    for count in range(1, int(stripes / finest) + 1):
        moved = count * finest
        if moved >= stripes:
            break
        if all(abs(moved / period - round(moved / period)) < least for period in periods):
            return moved
    return None
