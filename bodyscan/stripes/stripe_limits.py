"""Limits of the stripe coordinates that are decoded: those of points in the scan volume."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from bodyscan.arrays import Floats, Mask
from bodyscan.compiled import compiled

TILE_PX = 8  # fits into a word of 64 bits


@dataclass(frozen=True, eq=False)
class StripeLimits:
    """Stripe coordinates between which a pixel's point lies in the scan volume.

    near, far: (rows, columns) float32 at the corners of blocks of `block_px` x `block_px` camera
        pixels, linear between; s if it grows with depth and -s if it falls (`rising`), so that what
        lies deeper than wanted is beyond `far` either way. Nothing is wanted where far is below near.
    standing: likewise, where the volume's lowest layer begins. What lies in that layer, such as the
        floor, is wanted within `around_px` of something that stands higher; all of it if next to
        nothing does: a plate may lie there.
    """

    near: Floats
    far: Floats
    standing: Floats
    rising: bool
    block_px: int
    around_px: float

    def split(
        self, s: NDArray[np.int32] | Floats, usable: Mask, *, transposed: bool = False
    ) -> tuple[Mask, Mask]:
        """Find the pixels (L, P) of `usable` that are wanted, and those that lie beyond.

        s: (L, P) stripe coordinates or, as integers, stripes.
        transposed: the lines are the camera image's columns.
        """
        limits = np.stack([self.near, self.far, self.standing])
        limits = limits.transpose(0, 2, 1) if transposed else limits
        column = np.arange(s.shape[1]) // self.block_px
        share = ((np.arange(s.shape[1]) + 0.5) / self.block_px - column).astype(np.float32)
        left, right = (np.take(limits, column + k, axis=2) for k in (0, 1))
        limits = left + share * (right - left)
        middle = 0.5 if s.dtype.kind == "i" else 0.0
        there, deep = np.empty(s.shape, np.bool_), np.empty(s.shape, np.bool_)
        rows, columns = (-(-size // TILE_PX) for size in s.shape)
        standing = np.zeros((TILE_PX * rows, TILE_PX * columns), np.bool_)
        _split(s, middle, self.rising, usable, limits, self.block_px, there, deep, standing)
        if np.count_nonzero(standing) < 1e-3 * np.count_nonzero(there):
            return there, deep & ~there
        eights = standing.view(np.uint64).reshape(rows, TILE_PX, columns)
        tiles = eights.any(axis=1).view(np.uint8)
        reach = 2 * int(np.ceil(self.around_px / TILE_PX)) + 1
        tiles = cv2.dilate(tiles, np.ones((reach, reach), np.uint8))
        _keep(np.repeat(tiles, TILE_PX, axis=1).view(np.bool_), there, deep)
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
    standing: Mask,
) -> None:
    """Fill, in arrays of at least the image's size, what lies in the volume (`there`), in its
    lowest layer or beyond (`deep`), and higher than that layer (`standing`), (L, P) each.

    limits: (3, rows, P), near, far, standing at the upper and lower edges of blocks.
    """
    sign = np.float32(1.0 if rising else -1.0)
    offset = sign * np.float32(middle)
    for line in range(s.shape[0]):
        row = line // block_px
        share = np.float32((line + 0.5) / block_px - row)
        here = limits[:, row] + share * (limits[:, row + 1] - limits[:, row])
        _split_line(s[line], sign, offset, usable[line], here, there[line], deep[line])
        for x in range(s.shape[1]):
            standing[line, x] = there[line, x] & (not deep[line, x])


@compiled
def _split_line(
    s: NDArray[np.int32] | Floats,
    sign: np.float32,
    offset: np.float32,
    usable: Mask,
    limits: Floats,
    there: Mask,
    deep: Mask,
) -> None:
    # One array filled per loop: otherwise the compiler does not vectorise.
    near, far, low = limits[0], limits[1], limits[2]
    depth = np.empty(s.size, np.float32)
    for x in range(s.size):
        depth[x] = sign * np.float32(s[x]) + offset
    for x in range(s.size):
        there[x] = usable[x] & (depth[x] >= near[x]) & (depth[x] <= far[x])
    for x in range(s.size):
        deep[x] = usable[x] & (depth[x] > low[x]) & (far[x] > near[x])


@compiled
def _keep(tiles: Mask, there: Mask, deep: Mask) -> None:
    """Keep in `there` (L, P) what lies in one of the tiles (rows, P or more), and in `deep` what is
    not in `there`."""
    for line in range(there.shape[0]):
        tile = tiles[line // TILE_PX]
        for x in range(there.shape[1]):
            there[line, x] &= tile[x]
            deep[line, x] &= not there[line, x]
