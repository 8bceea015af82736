"""Exposures of the pairs evened out, so that a body's colour shows no seam from pair to pair."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bodyscan.arrays import Bytes, Floats

DARKEST = 8.0  # grey levels that say nothing of the exposure
FEWEST = 200
HOLD = 1e-3  # of an overlap's weight: pairs without overlap keep their own brightness


def gains(ratios: Sequence[tuple[int, int, float, int]], count: int) -> Floats:
    """(count,) factors that bring the pairs' grey levels together, their geometric mean 1.

    ratios: (a, b, log of b's grey level over a's where both see one spot, how many spots). Least
    squares in logarithms, so that the factors go round the ring without a step.
    """
    normal, right = HOLD * np.eye(count), np.zeros(count)
    for a, b, ratio, spots in ratios:
        weight = spots / sum(n for *_, n in ratios)
        normal[[a, b], [a, b]] += weight
        normal[[a, b], [b, a]] -= weight
        right[a] += weight * ratio
        right[b] -= weight * ratio
    logarithms = np.linalg.solve(normal, right)
    return np.exp(logarithms - logarithms.mean()).astype(np.float32)


def log_ratio(ours: Bytes | Floats, theirs: Bytes | Floats) -> tuple[float, int]:
    """Median log of `theirs` over `ours` (N,) grey levels, and of how many; 0 of too few."""
    bright = (ours > DARKEST) & (theirs > DARKEST)
    spots = int(np.count_nonzero(bright))
    if spots < FEWEST:
        return 0.0, 0
    return float(np.median(np.log(theirs[bright] / ours[bright].astype(np.float32)))), spots
