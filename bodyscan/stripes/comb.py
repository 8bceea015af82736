"""The comb that motion during a sequence makes of stripe boundaries.

In a bit code, boundaries of neighbouring stripes are seen in different images: every other one in
the finest pattern, a quarter of them in the next, and so on. A boundary's place belongs to the
moment of its own images, so on a moving surface neighbours stand out against each other like teeth,
by the speed times the time between them. No smooth surface does that.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodyscan.arrays import Array, Indices
from bodyscan.stripes.boundaries import Boundaries

TEETH = 8
"""Boundaries per window: half of them of the finest pattern, at least one of the fourth finest."""
DEGREE = 3
"""Degree of s along a window on a still surface: what bends more over 12 mm is an edge."""

ENOUGH = 16_000
"""Windows, evenly sampled: enough for a rigid speed to about
0.05 mm/s; all of them hardly do better."""
LEAST_TOLD = 1e-6
"""Share of the variance of times: what rounding leaves if they are a cubic of the index."""
COMMON_PX = 1e-3
"""By how much boundaries of one pattern may be shifted against another's all over an image, though
nothing moves: 0.0007 to 0.0017 on the boards of procam-board, which stood still."""


@dataclass(frozen=True, eq=False)
class Comb:
    """What windows of neighbouring boundaries on one scan line say about motion.

    s, pixels: (N, 2) and (N, 2, 2), stripe coordinates and places, px, of the first and the second
        half of each window.
    speed: (N,) how fast s changes at a fixed pixel, stripes per unit of time.
    sigma: (N,) standard deviation of the speed due to those of the boundaries.
    common: (N,) another one, due to an error that all windows share.
    """

    s: Array
    pixels: Array
    speed: Array
    sigma: Array
    common: Array


def find_comb(boundaries: Boundaries, times: Array, *, turned: bool) -> Comb:
    """Fit each window of boundaries, place against index, by a cubic plus a speed times the time.

    times: (N,) when each boundary was seen.
    turned: scan lines are the camera image's columns.

    Windows whose times do not differ from a cubic say nothing and are left out.
    """
    window = _window_starts(boundaries)[:, None] + np.arange(TEETH)
    still = _smooth_part()
    place, when = boundaries.position[window], times[window]
    teeth, clock = place - place @ still, when - when @ still
    told = np.sum(clock**2, axis=1)
    shown = told > LEAST_TOLD * np.var(times) if len(times) else told > 0.0
    window, place, teeth, clock = (each[shown] for each in (window, place, teeth, clock))
    told = told[shown]
    per_time = np.sum(clock * teeth, axis=1) / told
    variance = np.sum((clock * boundaries.sigma_px[window]) ** 2, axis=1) / told**2
    index = boundaries.index[window].astype(float)
    slope = (index[:, -1] - index[:, 0]) / (place[:, -1] - place[:, 0])
    along, beside, s = (
        each.reshape(-1, 2, TEETH // 2).mean(axis=2)
        for each in (place, boundaries.line_position[window], index)
    )
    pixels = np.stack([beside, along] if turned else [along, beside], axis=-1)
    sigma, common = np.abs(slope) * np.sqrt(variance), np.abs(slope) * COMMON_PX / np.std(times)
    return Comb(s, pixels, -slope * per_time, sigma, common)


def _window_starts(boundaries: Boundaries) -> Indices:
    """First boundaries of windows in unbroken runs with the index changing in one direction.

    Every scan line is cut between the same stripes: an error of one stripe is then in one window of
    each line, and not half in each of two, where it would look common to neighbours. The middle of
    a window is the boundary of its coarsest pattern: at an end the cubic would hide it.
    """
    count = len(boundaries.line)
    begins = np.flatnonzero(np.append(True, ~boundaries.joined)) if count else np.empty(0, np.int64)
    lengths = np.diff(np.append(begins, count))
    ends = np.repeat(begins + lengths, lengths)
    first = np.flatnonzero(np.arange(count) + TEETH <= ends)
    one, other = boundaries.index[first], boundaries.index[first + TEETH - 1]
    first = first[
        (np.abs(other - one) == TEETH - 1) & (np.minimum(one, other) % TEETH == TEETH // 2)
    ]
    return np.asarray(first[:: 1 + len(first) // ENOUGH], np.int64)


def _smooth_part() -> Array:
    """Projection (TEETH, TEETH) of a window's values onto a cubic."""
    powers = np.vander(np.linspace(-1.0, 1.0, TEETH), DEGREE + 1)
    basis, _ = np.linalg.qr(powers)
    return np.asarray(basis @ basis.T, np.float64)
