"""What the projector shows: reflected binary code, most significant bit first, and its light.

Written for the simulator alone; it shares nothing with `bodyscan.stripes`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import oaconvolve

from bodyscan.arrays import Array, Floats, Mask

PAD = 4
"""Stripes by which a table of light extends beyond the sweep."""

FINE = 128
"""Entries of a table of light per stripe."""


def bit_count(stripes: int) -> int:
    """Number of patterns needed to tell the stripes apart."""
    return int(np.ceil(np.log2(stripes)))


def code_bits(stripes: int, first: int = 0) -> Mask:
    """Whether stripe i is lit in pattern k, (bits, stripes), 0 the most significant.

    first: the number of stripe 0.
    """
    index = np.arange(first, first + stripes)
    code = index ^ (index >> 1)
    places = np.arange(bit_count(first + stripes))[::-1]
    return (code >> places[:, None] & 1).astype(bool)


@dataclass(frozen=True, eq=False)
class LightTable:
    """Light as a function of the stripe coordinate, one row for each of several blurs.

    values: (blurs, entries) float32 in 0..1.
    """

    values: Floats

    def at(self, index: NDArray[np.int32]) -> Floats:
        """Light at entries from `table_index`."""
        return self.values.ravel().take(index)


def table_index(
    s: NDArray[np.floating], stripes: int, blur: NDArray[np.integer] | None = None
) -> NDArray[np.int32]:
    """Table entry of a stripe coordinate (NaN: outside the sweep), in the row of its blur if
    several."""
    entries = (stripes + 2 * PAD) * FINE
    place = np.nan_to_num((s + PAD) * FINE, nan=0.0, posinf=0.0, neginf=0.0)
    index = np.clip(place, 0, entries - 1).astype(np.int32)
    return index if blur is None else (index + blur * entries).astype(np.int32)


def light_table(
    lit: NDArray[Any],
    blurs: Array,
    jitter: Array | None = None,
    parts: int = 1,
) -> LightTable:
    """Light of one frame: the lit stripes, blurred by Gaussians.

    lit: (S,), or (S * parts,) if light changes inside stripes.
    blurs: (B,) standard deviations in stripes.
    jitter: (S + 1,) displacement of each boundary, in stripes.
    """
    stripes = len(lit) // parts
    boundaries = np.arange(stripes + 1, dtype=float)
    if jitter is not None:
        boundaries = np.maximum.accumulate(boundaries + jitter)
    if parts > 1:
        within = np.arange(stripes * parts + 1) / parts
        boundaries = np.interp(within, np.arange(stripes + 1.0), boundaries)
    energy = np.concatenate([[0.0], np.cumsum(lit * np.diff(boundaries))])
    edges = np.arange((stripes + 2 * PAD) * FINE + 1) / FINE - PAD
    sharp = np.diff(np.interp(edges, boundaries, energy)) * FINE
    return LightTable(_smeared(sharp.astype(np.float32), tuple(blurs.tolist())))


def _smeared(values: Floats, blurs: tuple[float, ...]) -> Floats:
    """Values (N,) blurred by each blur, (B, N); block-wise Fourier transforms are ten times
    quicker."""
    if max(blurs) <= 0:
        return np.repeat(values[None], len(blurs), axis=0)
    padded = np.pad(values, PAD * FINE, mode="edge")
    return np.asarray(oaconvolve(padded[None], _kernels(blurs), mode="valid", axes=1), np.float32)


@lru_cache(maxsize=8)
def _kernels(blurs: tuple[float, ...]) -> Floats:
    """Gaussians (B, k) with these standard deviations in stripes, cut at four of them or at PAD."""
    place = np.arange(-PAD * FINE, PAD * FINE + 1) / FINE
    reached = np.minimum(4.0 * np.array(blurs), PAD)[:, None]
    spread = np.maximum(blurs, 1e-3 / FINE)[:, None]
    bells = np.exp(-0.5 * (place / spread) ** 2) * (
        np.abs(place) <= np.maximum(reached, 0.5 / FINE)
    )
    return np.asarray(bells / bells.sum(axis=1, keepdims=True), np.float32)
