"""Boundaries of some scan lines only: a board shows more of them than any fit needs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np

from bodyscan.arrays import Array, Greys, Indices, Mask

ASIDE, MARGIN = 2, 8
"""Lines beside a band from which edges of brightness may pull boundaries into it, and those needed
to judge the pixels of these: brightness looks 3 lines aside (`albedo_edges`), at pixels that depend
on 2 more (`usable_pixels`)."""


@dataclass(frozen=True)
class LineBands:
    """One in `every` of the bands of `width` neighbouring lines; `turn` says which.

    corner: row and column of the camera's image at which the images begin. Bands are counted from
        the camera image's first line, so that they do not depend on the crop.
    """

    width: int
    every: int
    turn: int
    corner: tuple[int, int]

    def lines(self, count: int, *, turned: bool) -> BandLines:
        """The lines to use out of `count`; turned: they are columns."""
        band = (self.corner[turned] + np.arange(count)) // self.width
        inside = band % self.every == self.turn % self.every
        near, wanted = (_widened(inside, by) for by in (MARGIN, ASIDE))
        return BandLines(np.flatnonzero(near), wanted[near], inside)


def _widened(lines: Mask, by: int) -> Mask:
    return np.asarray(np.convolve(lines, np.ones(2 * by + 1), "same") > 0.0)


@dataclass(frozen=True, eq=False)
class BandLines:
    """Lines in and around bands.

    number: (L,) of lines to examine.
    wanted: (L,) those whose boundaries may lie in a band.
    inside: (count,) of all lines, those in a band.
    """

    number: Indices
    wanted: Mask
    inside: Mask

    def places(self, line: Indices, place: Array) -> tuple[Array, Mask]:
        """Places across all lines (N,) px, and which of them are in a band (N,), of boundaries on
        lines (N,) of these at places (N,) across them."""
        place = place + (self.number - np.arange(len(self.number)))[line]
        nearest = np.clip(np.floor(place).astype(np.int64), 0, len(self.inside) - 1)
        return place, self.inside[nearest]

    def cut(self, images: Greys, *, turned: bool) -> Greys:
        """These rows, or columns if turned, of images (..., H, W)."""
        ends = np.flatnonzero(np.diff(self.number) > 1) + 1
        runs = [slice(run[0], run[-1] + 1) for run in np.split(self.number, ends)]
        parts = [images[..., run] if turned else images[..., run, :] for run in runs]
        return cast(Greys, np.concatenate(parts, axis=-1 if turned else -2))
