"""The period of the finest wave that a pixel shows: the one with which all other waves agree best.

A fine wave gives s exactly, except for whole periods. Each s that it leaves open predicts a phase for
the other waves; their distance from it, in sigmas, gives the likelihood of that s. The same rule
applies whether a single period covers all stripes (hierarchical unwrapping) or the waves only beat
(heterodyne). A pixel whose second-best s is nearly as likely gets no order rather than a guess.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bodyscan.arrays import Array, Floats, Indices, Mask
from bodyscan.compiled import compiled
from bodyscan.stripes.phase.waves import MeasuredWave

MIN_GAIN = -2.0 * math.log(1e-4)
"""Minimum difference of the second-best order's chi squared: a wrong order has a chance of 1e-4 then,
one flying pixel in ten thousand, which cleaning finds."""
MAX_SIGMAS = 4.5
"""Between two waves at one pixel: one in 150,000 by noise; otherwise the pixel sees two surfaces."""
MIN_PIXELS = 100


@dataclass(frozen=True, eq=False)
class PhaseOrder:
    """s and its standard deviation (L, P), stripes, and where the order is `certain`.

    agreed: share of the pixels whose waves agree, among those whose order noise leaves decidable.
    offsets: median difference of each other wave from the finest, in turns of the finest.
    """

    s: Floats
    sigma: Floats
    certain: Mask
    agreed: float
    offsets: tuple[float, ...]


def find_phase_order(
    waves: Sequence[MeasuredWave], sigmas: Sequence[Floats], usable: Mask, stripes: int
) -> PhaseOrder:
    """Find s from waves (the finest first) and the sigmas (L, P) of their turns at `usable` pixels
    (L, P)."""
    periods = np.array([wave.wave.period for wave in waves])
    turns = np.stack([wave.turn[usable] for wave in waves])
    errors = np.stack([sigma[usable] for sigma in sigmas])
    some = slice(None, None, max(1, turns.shape[1] // 100_000))
    sample = turns[:, some], errors[:, some].copy()
    # Of waves without error the best order has a chi squared of 0.
    gap = find_best_orders(np.zeros_like(sample[0]), sample[1], periods, float(stripes))[2]
    decidable = gap >= 3.0 * MIN_GAIN
    orders, _, _ = find_best_orders(*sample, periods, float(stripes))
    errors *= _estimate_growth(*sample, periods, orders)[:, None]
    orders, best, second = find_best_orders(turns, errors, periods, float(stripes))
    residual, residual_sigma = _compute_residuals(turns, errors, periods, orders)
    agree = np.all(np.abs(residual) <= MAX_SIGMAS * residual_sigma, axis=0)
    decided = second - best >= MIN_GAIN
    s, sigma = _average_waves(turns, errors, periods, orders, residual)
    inside = (s > MAX_SIGMAS * sigma) & (s < stripes - MAX_SIGMAS * sigma)
    all_s, all_sigma = (np.full(usable.shape, np.nan, np.float32) for _ in range(2))
    all_s[usable], all_sigma[usable] = s, sigma
    certain = np.zeros(usable.shape, bool)
    certain[usable] = agree & decided & inside
    scaled = residual * (periods[1:, None] / periods[0])
    medians = np.median(scaled, axis=1).tolist() if scaled.size else [0.0] * len(scaled)
    judged = (agree & decided)[some]
    # On a dim background most pixels may be too noisy to decide; those do not count.
    judged = judged[decidable] if np.count_nonzero(decidable) >= MIN_PIXELS else judged
    agreed = float(np.mean(judged)) if judged.size else 0.0
    return PhaseOrder(all_s, all_sigma, certain, agreed, tuple(medians))


def _compute_residuals(
    turns: Floats, sigmas: Floats, periods: Array, orders: Indices
) -> tuple[Floats, Floats]:
    """Turns (W - 1, M) by which the other waves differ from where the finest predicts them, and
    their standard deviation."""
    ratio = (periods[0] / periods[1:, None]).astype(np.float32)
    residual = turns[1:] - (turns[0] + orders.astype(np.float32)) * ratio
    return residual - np.rint(residual), np.hypot(sigmas[1:], sigmas[0] * ratio)


def _estimate_growth(turns: Floats, sigmas: Floats, periods: Array, orders: Indices) -> Floats:
    """Factor (W,) by which each wave's sigma must grow to explain the residuals: the remainder of
    the projector's response, and indirect light, are not noise."""
    growth = np.ones(len(periods), np.float32)
    if turns.shape[1] >= MIN_PIXELS:
        residual, residual_sigma = _compute_residuals(turns, sigmas, periods, orders)
        ratio = np.median(np.abs(residual) / residual_sigma, axis=1) / 0.6745
        growth[1:] = np.maximum(ratio, 1.0)
    return growth


def _average_waves(
    turns: Floats, sigmas: Floats, periods: Array, orders: Indices, residual: Floats
) -> tuple[Floats, Floats]:
    """Weighted mean of s from the waves up to twice as long as the finest, and its standard
    deviation (M,); longer ones add more errors than they remove noise."""
    weights = 1.0 / np.square(sigmas * periods[:, None].astype(np.float32))
    weights[periods > 2.0 * periods[0]] = 0.0
    moved = np.sum(weights[1:] * residual * periods[1:, None].astype(np.float32), axis=0)
    total = np.sum(weights, axis=0)
    s = (turns[0] + orders) * periods[0] + moved / total
    return s.astype(np.float32), (1.0 / np.sqrt(total)).astype(np.float32)


@compiled
def find_best_orders(
    turns: Floats, sigmas: Floats, periods: Array, stripes: float
) -> tuple[Indices, Array, Array]:
    """Find the likeliest whole periods of the finest wave at M pixels, and chi squared of these and
    of the second best (M,). turns, sigmas: (W, M)."""
    count = turns.shape[1]
    orders = np.zeros(count, np.int64)
    best, second = np.full(count, np.inf), np.full(count, np.inf)
    ratios = periods[0] / periods
    for pixel in range(count):
        order, turn = 0, np.float64(turns[0, pixel])
        while (turn + order) * periods[0] < stripes:
            cost = 0.0
            for wave in range(1, periods.size):
                residual = turns[wave, pixel] - (turn + order) * ratios[wave]
                residual -= math.floor(residual + 0.5)
                variance = sigmas[wave, pixel] ** 2 + (sigmas[0, pixel] * ratios[wave]) ** 2
                cost += residual * residual / variance
            if cost < best[pixel]:
                second[pixel], best[pixel], orders[pixel] = best[pixel], cost, order
            elif cost < second[pixel]:
                second[pixel] = cost
            order += 1
    return orders, best, second
