"""Scatter of boundaries about smooth runs of their neighbours, compared with their sigmas.

Grey noise is measured where two images show the same thing. But JPEG errs with the content of an
image, exposures vary from a pattern to its inverse, and pixels of projector and camera beat: each
shifts a boundary relative to its neighbours, and all of it shows here.
"""

from __future__ import annotations

import numpy as np

from bodyscan.geometry.robust import SIGMAS_PER_MEDIAN
from bodyscan.stripes.boundaries import Boundaries
from bodyscan.stripes.stripe_coordinates import REACH_PX, SMOOTHERS

FEWEST, ENOUGH = 1000, 20_000
CLEARLY = 1.2
"""Sigmas too small by this factor are corrected; less may be due to the surface."""


def scatter(boundaries: Boundaries) -> float:
    """Robust ratio of seen to claimed distances from a parabola through five boundaries of a run; 1
    if it is not clearly more, or there are too few."""
    weights = SMOOTHERS[0]
    middle, span = len(weights) // 2, len(weights) - 1
    if len(boundaries.joined) < span:
        return 1.0
    starts = len(boundaries.joined) - span + 1
    first = np.arange(0, starts, max(1, starts // ENOUGH))
    run = boundaries.position[first + span] - boundaries.position[first] < 2.0 * REACH_PX
    for k in range(span):
        run &= boundaries.joined[first + k]
    first = first[run]
    if len(first) < FEWEST:
        return 1.0
    off, variance = np.zeros(len(first)), np.zeros(len(first))
    for k, weight in enumerate(weights):
        share = weight - (k == middle)
        off += share * boundaries.position[first + k]
        variance += (share * boundaries.sigma_px[first + k]) ** 2
    found = SIGMAS_PER_MEDIAN * float(np.median(np.abs(off) / np.sqrt(variance)))
    return found if found > CLEARLY else 1.0
