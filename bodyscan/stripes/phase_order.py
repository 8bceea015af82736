"""Which period of the finest wave a pixel shows: the one with which all other waves agree best.

A fine wave gives s exactly, except for whole periods. Each s that it leaves open predicts a phase
for the other waves; their distance from it, in sigmas, gives the likelihood of that s. The same
rule applies whether a single period covers all stripes (hierarchical unwrapping) or the waves only
beat (heterodyne). A pixel whose second-best s is nearly as likely gets no order rather than a
guess.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bodyscan.arrays import Array, Floats, Indices, Mask
from bodyscan.compiled import compiled
from bodyscan.stripes.waves import WaveSeen

CHANCE = 1e-4
"""Greatest chance of a wrong order: one flying pixel in ten thousand, which cleaning finds."""

MOST_SIGMAS = 4.5
"""Between two waves at one pixel: one in 150,000 by noise; otherwise the pixel sees two
surfaces."""

TOLD = -2.0 * math.log(CHANCE)
"""How much greater chi squared of the second-best order must be."""

EASY = 3.0
"""Times that, if only noise is present: the order of such pixels is certain."""

ENOUGH = 100
MOST_SAMPLED = 100_000
COMBINED = 2.0
"""Waves up to this many times as long as the finest help to find s; longer ones would add more of
their own errors than they remove of its noise."""


@dataclass(frozen=True, eq=False)
class PhaseOrder:
    """s and its standard deviation (L, P), stripes, and where the order is `certain`.

    agreed: share of the pixels whose waves agree, among those whose order noise leaves decidable.
    apart: how many turns of the finest wave each other one is off overall.
    misfit: how many sigmas they are off; 1 if noise explains it.
    """

    s: Floats
    sigma: Floats
    certain: Mask
    agreed: float
    apart: tuple[float, ...]
    misfit: float


def phase_order(
    waves: Sequence[WaveSeen], sigmas: Sequence[Floats], usable: Mask, stripes: int
) -> PhaseOrder:
    """Find s from waves (the finest first), their turns'
    sigmas (L, P), at `usable` pixels (L, P)."""
    periods = np.array([wave.wave.period for wave in waves])
    turns = np.stack([wave.turn[usable] for wave in waves])
    doubts = np.stack([sigma[usable] for sigma in sigmas])
    some = slice(None, None, max(1, turns.shape[1] // MOST_SAMPLED))
    sample = turns[:, some], doubts[:, some].copy()
    tellable = _least_gap(sample[1], periods, float(stripes)) >= EASY * TOLD
    orders, _, _ = _best_orders(*sample, periods, float(stripes))
    growth = _beyond_noise(*sample, periods, orders)
    doubts *= growth[:, None]
    orders, best, second = _best_orders(turns, doubts, periods, float(stripes))
    off, off_sigma = _apart(turns, doubts, periods, orders)
    agree = np.all(np.abs(off) <= MOST_SIGMAS * off_sigma, axis=0)
    told = second - best >= TOLD
    s, sigma = _combined(turns, doubts, periods, orders, off)
    inside = (s > MOST_SIGMAS * sigma) & (s < stripes - MOST_SIGMAS * sigma)
    certain = agree & told & inside
    whole_s, whole_sigma = (np.full(usable.shape, np.nan, np.float32) for _ in range(2))
    whole_s[usable], whole_sigma[usable] = s, sigma
    whole_certain = np.zeros(usable.shape, bool)
    whole_certain[usable] = certain
    apart = tuple(_middle(off * (periods[1:, None] / periods[0])))
    agreed, misfit = _share((agree & told)[some], tellable), float(growth.max())
    return PhaseOrder(whole_s, whole_sigma, whole_certain, agreed, apart, misfit)


def _share(agree: Mask, tellable: Mask) -> float:
    """Share of pixels that agree. On a dim background most may be too noisy to decide; those do not
    count."""
    judged = agree[tellable] if np.count_nonzero(tellable) >= ENOUGH else agree
    return float(np.mean(judged)) if judged.size else 0.0


def _middle(values: Floats) -> list[float]:
    """Medians of the rows (W, M)."""
    return np.median(values, axis=1).tolist() if values.size else [0.0] * len(values)


def _apart(turns: Floats, sigmas: Floats, periods: Array, orders: Indices) -> tuple[Floats, Floats]:
    """Turns (W - 1, M) by which the other waves are off from where the finest predicts them, and
    their standard deviation."""
    ratio = (periods[0] / periods[1:, None]).astype(np.float32)
    off = turns[1:] - (turns[0] + orders.astype(np.float32)) * ratio
    return off - np.rint(off), np.hypot(sigmas[1:], sigmas[0] * ratio)


def _beyond_noise(turns: Floats, sigmas: Floats, periods: Array, orders: Indices) -> Floats:
    """Factor (W,) by which each wave's sigma must grow to explain what is seen: the remainder of
    the projector's response, and indirect light, are not noise."""
    growth = np.ones(len(periods), np.float32)
    if turns.shape[1] >= ENOUGH:
        off, off_sigma = _apart(turns, sigmas, periods, orders)
        seen = np.median(np.abs(off) / off_sigma, axis=1) / 0.6745
        growth[1:] = np.maximum(seen, 1.0)
    return growth


def _combined(
    turns: Floats, sigmas: Floats, periods: Array, orders: Indices, off: Floats
) -> tuple[Floats, Floats]:
    """s and its standard deviation (M,): weighted mean of the
    waves with about the finest's period."""
    weights = 1.0 / np.square(sigmas * periods[:, None].astype(np.float32))
    weights[periods > COMBINED * periods[0]] = 0.0
    moved = np.sum(weights[1:] * off * periods[1:, None].astype(np.float32), axis=0)
    total = np.sum(weights, axis=0)
    s = (turns[0] + orders) * periods[0] + moved / total
    return s.astype(np.float32), (1.0 / np.sqrt(total)).astype(np.float32)


@compiled
def _least_gap(sigmas: Floats, periods: Array, stripes: float) -> Array:
    """How much greater (M,) chi squared of any other order is if waves have no error."""
    count = sigmas.shape[1]
    least = np.full(count, np.inf)
    ratios = periods[0] / periods
    for pixel in range(count):
        order = 1
        while order * periods[0] < stripes:
            cost = 0.0
            for wave in range(1, periods.size):
                off = order * ratios[wave]
                off -= math.floor(off + 0.5)
                doubt2 = sigmas[wave, pixel] ** 2 + (sigmas[0, pixel] * ratios[wave]) ** 2
                cost += off * off / doubt2
            least[pixel] = min(least[pixel], cost)
            order += 1
    return least


@compiled
def _best_orders(
    turns: Floats, sigmas: Floats, periods: Array, stripes: float
) -> tuple[Indices, Array, Array]:
    """The likeliest whole periods of the finest wave at M pixels, and chi squared of these and of
    the second best (M,). turns, sigmas: (W, M)."""
    count = turns.shape[1]
    orders = np.zeros(count, np.int64)
    best, second = np.full(count, np.inf), np.full(count, np.inf)
    ratios = periods[0] / periods
    for pixel in range(count):
        order, turn = 0, np.float64(turns[0, pixel])
        while (turn + order) * periods[0] < stripes:
            cost = 0.0
            for wave in range(1, periods.size):
                off = turns[wave, pixel] - (turn + order) * ratios[wave]
                off -= math.floor(off + 0.5)
                doubt2 = sigmas[wave, pixel] ** 2 + (sigmas[0, pixel] * ratios[wave]) ** 2
                cost += off * off / doubt2
            if cost < best[pixel]:
                second[pixel], best[pixel], orders[pixel] = best[pixel], cost, order
            elif cost < second[pixel]:
                second[pixel] = cost
            order += 1
    return orders, best, second
