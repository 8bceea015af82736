"""Which stripes of a picture are worth decoding: those of the scan volume, and not of the room."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bodyscan.compiled import compiled

Floats = NDArray[np.float32]
Mask = NDArray[np.bool_]

BLOCK_PX = 64


@dataclass(frozen=True, eq=False)
class WantedStripes:
    """Stripe coordinates between which each block of BLOCK_PX x BLOCK_PX camera pixels is wanted.

    near, far: (rows, columns) float32, s where it grows with depth and -s where it falls (`rising`),
    so that what lies deeper than wanted is beyond `far` either way. NaN where nothing is wanted.
    """

    near: Floats
    far: Floats
    rising: bool

    def split(
        self, s: NDArray[np.int32] | Floats, usable: Mask, *, turned: bool = False
    ) -> tuple[Mask, Mask]:
        """(L, P) pixels of `usable` that are wanted, and those that lie beyond.

        s: (L, P) stripe coordinates or, as integers, stripes.  turned: the lines are the camera
        image's columns.
        """
        near, far = (self.near.T, self.far.T) if turned else (self.near, self.far)
        wanted, beyond = np.zeros(s.shape, np.bool_), np.zeros(s.shape, np.bool_)
        middle = 0.5 if s.dtype.kind == "i" else 0.0
        _split(s, middle, self.rising, usable, near, far, wanted, beyond)
        return wanted, beyond


@compiled
def _split(
    s: NDArray[np.int32] | Floats,
    middle: float,
    rising: bool,
    usable: Mask,
    near: Floats,
    far: Floats,
    wanted: Mask,
    beyond: Mask,
) -> None:
    lines, places = s.shape
    sign = np.float32(1.0 if rising else -1.0)
    offset = sign * np.float32(middle)
    first, last = np.empty(places, np.float32), np.empty(places, np.float32)
    for line in range(lines):
        if line % BLOCK_PX == 0:
            for place in range(places):
                first[place] = near[line // BLOCK_PX, place // BLOCK_PX] - offset
                last[place] = far[line // BLOCK_PX, place // BLOCK_PX] - offset
        for place in range(places):
            depth, lit = sign * np.float32(s[line, place]), usable[line, place]
            wanted[line, place] = lit & (depth >= first[place]) & (depth <= last[place])
            beyond[line, place] = lit & (depth > last[place])
