"""Exposures of the pairs evened out, so that a body's colour shows no seam from pair to pair."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from bodyscan.arrays import Bytes, Floats
from bodyscan.fusion.comparing import Evidence
from bodyscan.fusion.smoothing import SmoothSurface
from bodyscan.fusion.thinning import Samples

DARKEST = 8.0  # grey levels that say nothing of the exposure
FEWEST = 200
SPOTS = 5000  # of an overlap are enough to compare exposures
HOLD = 1e-3  # of an overlap's weight: pairs without overlap keep their own brightness


def even_exposures(
    samples: Samples, surfaces: Sequence[SmoothSurface], evidence: Sequence[Evidence]
) -> Floats:
    """(P,) factors for the surfaces' grey levels, from where two of them show one spot."""
    ratios = []
    for b, (surface, one) in enumerate(zip(surfaces, evidence, strict=True)):
        starts = np.searchsorted(one.index, samples.starts)
        for a, (start, end) in enumerate(pairwise(starts)):
            step = 1 + (end - start) // SPOTS
            some = slice(start, end, step)
            ours, theirs = samples.colours[one.index[some]], surface.colours[one.at[some]]
            ratio, spots = log_ratio(ours, theirs.astype(np.float32))
            ratios.append((a, b, ratio, spots * step))
    return gains([ratio for ratio in ratios if ratio[-1]], len(evidence))


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
