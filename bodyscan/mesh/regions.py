"""Regions of a body's surface: skin, or what covers it."""

from __future__ import annotations

import numpy as np

from bodyscan.arrays import Array, Bytes, Indices

UNSURE, SKIN, HAIR, DARK_CLOTH = range(4)
NAMES = ("unsure", "skin", "hair", "dark cloth")
"""In the order of the numbers in files."""


SOME = 0.005
"""Share of the points; less is a few moles and rims."""


def shares(regions: Bytes, sizes: Array | None = None) -> dict[str, float]:
    """Share of each region, by name, in regions (N,), weighted by sizes (N,)."""
    counts = np.bincount(regions, sizes, len(NAMES))
    return dict(zip(NAMES, (counts / max(counts.sum(), 1e-12)).tolist(), strict=True))


def regions_at(regions: Bytes | None, places: Indices) -> Bytes | None:
    """Regions (M,) at places (M,) of regions (N,); unsure where a place is -1, since what is new
    has none. None if regions are unknown."""
    if regions is None:
        return None
    return np.where(places >= 0, regions[places], np.uint8(UNSURE))


def of_faces(regions: Bytes, faces: Indices) -> Bytes:
    """Region (F,) of at least two corners of faces (F, 3),
    from vertices' regions (V,); else unsure."""
    a, b, c = regions[faces].T
    return np.where((a == b) | (a == c), a, np.where(b == c, b, np.uint8(UNSURE)))


def covered_shares(regions: Bytes | None) -> dict[str, float]:
    """Shares of what covers the skin, or may, if large enough to mention; empty if unknown."""
    if regions is None:
        return {}
    return {
        name: part for name, part in shares(regions).items() if name != NAMES[SKIN] and part > SOME
    }
