"""What a place of a body's surface is: skin, or what covers it."""

from __future__ import annotations

import numpy as np

from bodyscan.arrays import Array, Bytes, Indices

UNSURE, SKIN, HAIR, DARK_CLOTH = range(4)
NAMES = ("unsure", "skin", "hair", "dark cloth")
"""In the order of the numbers that files hold."""


SOME = 0.005
"""Of the points: less is a few moles and rims."""


def shares(regions: Bytes, sizes: Array | None = None) -> dict[str, float]:
    """Of each region by its name, its part of regions (N,), each as large as sizes (N,) say."""
    counts = np.bincount(regions, sizes, len(NAMES))
    return dict(zip(NAMES, (counts / max(counts.sum(), 1e-12)).tolist(), strict=True))


def regions_at(regions: Bytes | None, places: Indices) -> Bytes | None:
    """(M,) of regions (N,) those at places (M,), unsure where a place is -1, as what is new has none;
    None where nothing is known of regions."""
    if regions is None:
        return None
    return np.where(places >= 0, regions[places], np.uint8(UNSURE))


def of_faces(regions: Bytes, faces: Indices) -> Bytes:
    """(F,) of faces (F, 3): what two corners at least are, of vertices' regions (V,); else unsure."""
    a, b, c = regions[faces].T
    return np.where((a == b) | (a == c), a, np.where(b == c, b, np.uint8(UNSURE)))


def covered_shares(regions: Bytes | None) -> dict[str, float]:
    """Of what covers the skin, or may: those shares that one speaks of; none where none is known."""
    if regions is None:
        return {}
    return {
        name: part for name, part in shares(regions).items() if name != NAMES[SKIN] and part > SOME
    }
