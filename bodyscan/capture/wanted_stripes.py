"""Which stripes of a picture are worth decoding: those of what stands in the scan volume."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from bodyscan.compiled import compiled

Bytes = NDArray[np.uint8]
Floats = NDArray[np.float32]
Mask = NDArray[np.bool_]

TILE_PX = 8


@dataclass(frozen=True, eq=False)
class WantedStripes:
    """Between which stripe coordinates a pixel's point lies in the scan volume.

    near, far: (rows, columns) float32 at the corners of blocks of `block_px` x `block_px` camera
    pixels, linear between; s where it grows with depth and -s where it falls (`rising`), so that
    what lies deeper than wanted is beyond `far` either way. Where far is below near, nothing is.
    standing: likewise, where the volume's lowest layer begins. What lies in that layer, as the
    floor does, is wanted within `around_px` of something that stands higher.
    """

    near: Floats
    far: Floats
    standing: Floats
    rising: bool
    block_px: int
    around_px: float

    def split(
        self, s: NDArray[np.int32] | Floats, usable: Mask, *, turned: bool = False
    ) -> tuple[Mask, Mask]:
        """(L, P) pixels of `usable` that are wanted, and those that lie beyond.

        s: (L, P) stripe coordinates or, as integers, stripes.  turned: the lines are the camera
        image's columns.
        """
        limits = np.stack([self.near, self.far, self.standing])
        limits = np.ascontiguousarray(limits.transpose(0, 2, 1)) if turned else limits
        middle = 0.5 if s.dtype.kind == "i" else 0.0
        there, deep = np.empty(s.shape, np.bool_), np.empty(s.shape, np.bool_)
        tiles = np.zeros([-(-size // TILE_PX) for size in s.shape], np.uint8)
        _split(s, middle, self.rising, usable, limits, self.block_px, there, deep, tiles)
        reach = 2 * int(np.ceil(self.around_px / TILE_PX)) + 1
        _spread(cv2.dilate(tiles, np.ones((reach, reach), np.uint8)), there, deep)
        return there, deep


@compiled
def _split(
    s: NDArray[np.int32] | Floats,
    middle: float,
    rising: bool,
    usable: Mask,
    limits: Floats,
    block_px: int,
    there: Mask,
    deep: Mask,
    tiles: Bytes,
) -> None:
    """Fills in what lies in the volume (L, P), what lies in its lowest layer or beyond (L, P), and
    the tiles with something that stands higher than that layer.

    limits: (3, rows, columns), near, far, standing.
    """
    sign = np.float32(1.0 if rising else -1.0)
    offset, size = sign * np.float32(middle), np.float32(block_px)
    lines, places = s.shape
    standing = np.empty(places, np.bool_)
    for line in range(lines):
        row = line // block_px
        share = np.float32(line + 0.5 - row * block_px) / size
        edges = limits[:, row] + share * (limits[:, row + 1] - limits[:, row])
        near, far = _between(edges[0], places, block_px), _between(edges[1], places, block_px)
        low = _between(edges[2], places, block_px)
        for place in range(places):
            depth, lit = sign * np.float32(s[line, place]) + offset, usable[line, place]
            there[line, place] = lit & (depth >= near[place]) & (depth <= far[place])
            deep[line, place] = lit & (depth > low[place]) & (far[place] > near[place])
            standing[place] = there[line, place] & (depth <= low[place])
        for place in range(places):
            tiles[line // TILE_PX, place // TILE_PX] |= standing[place]


@compiled
def _between(edges: Floats, places: int, block_px: int) -> Floats:
    """(P,) values at pixels' middles, linear between those at blocks' edges (columns,)."""
    values = np.empty(places, np.float32)
    for column in range((places + block_px - 1) // block_px):
        first = column * block_px
        step = (edges[column + 1] - edges[column]) / np.float32(block_px)
        for k in range(min(block_px, places - first)):
            values[first + k] = edges[column] + (np.float32(k) + np.float32(0.5)) * step
    return values


@compiled
def _spread(tiles: Bytes, there: Mask, deep: Mask) -> None:
    """Leaves `there` what lies in one of the tiles, and `deep` what is not there."""
    for line in range(there.shape[0]):
        for place in range(there.shape[1]):
            there[line, place] &= tiles[line // TILE_PX, place // TILE_PX] > 0
        for place in range(there.shape[1]):
            deep[line, place] &= not there[line, place]
