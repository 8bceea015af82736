"""Scatter of boundaries about smooth runs of their neighbours, compared with their sigmas.

Grey noise is measured where two images show the same thing. But JPEG errs with the content of an
image, exposures vary from a pattern to its inverse, and pixels of projector and camera beat: each
shifts a boundary relative to its neighbours, and all of it shows here. So does relief finer than
the stripes (hair), where noise is low enough.
"""

from __future__ import annotations

import cv2
import numpy as np

from bodyscan.arrays import Array, Floats, Indices
from bodyscan.geometry.robust import SIGMAS_PER_MEDIAN
from bodyscan.stripes.boundaries import Boundaries
from bodyscan.stripes.stripe_coordinates import REACH_PX, SMOOTHERS

FEWEST, ENOUGH = 1000, 20_000
CLEARLY = 1.2
"""Sigmas too small by this factor are corrected; less may be due to the surface."""

WINDOW_PX, FAR, SURELY = 31, 3.0, 3.0
"""Window around a boundary, with some 400 others; sigmas beyond which one counts no more, since it
strays alone; and sigmas by which a mean square must exceed that of CLEARLY."""


def scatter(boundaries: Boundaries) -> float:
    """Robust ratio of seen to claimed distances from a parabola through five boundaries of a run; 1
    if it is not clearly more, or there are too few."""
    starts = len(boundaries.joined) - len(SMOOTHERS[0]) + 2
    off = _strays(boundaries, max(1, starts // ENOUGH))[1]
    if len(off) < FEWEST:
        return 1.0
    found = SIGMAS_PER_MEDIAN * float(np.median(np.abs(off)))
    return found if found > CLEARLY else 1.0


def local_scatter(boundaries: Boundaries) -> Array:
    """The same ratio, at most FAR, in the window around each boundary, (N,); 1 where it is not
    clearly more."""
    middle, off = _strays(boundaries, 1)
    if not len(middle):
        return np.ones(len(boundaries.line))
    places = int(boundaries.before.max()) + 1
    at = boundaries.line * places + boundaries.before
    size = (int(boundaries.line.max()) + 1) * places

    def around(values: Array | None) -> Floats:
        total = np.bincount(at[middle], values, size).reshape(-1, places).astype(np.float32)
        window = (WINDOW_PX, WINDOW_PX)
        summed = cv2.boxFilter(total, -1, window, normalize=False, borderType=cv2.BORDER_CONSTANT)
        return np.asarray(summed.ravel()[at])

    count = np.maximum(around(None), 1.0)
    mean = around(np.minimum(np.square(off), FAR**2)) / count
    # The mean of n squares of normal deviates is known to sqrt(2 / n).
    clearly = mean > CLEARLY**2 + SURELY * np.sqrt(2.0 / count)
    return np.sqrt(np.where(clearly, mean, 1.0))


def _strays(boundaries: Boundaries, step: int) -> tuple[Indices, Array]:
    """Every `step`th boundary in the middle of five of a run (M,), and how far it lies from a
    parabola through the five, in claimed sigmas (M,)."""
    weights = SMOOTHERS[0]
    middle, span = len(weights) // 2, len(weights) - 1
    first = np.arange(0, max(len(boundaries.joined) - span + 1, 0), step)
    run = boundaries.position[first + span] - boundaries.position[first] < 2.0 * REACH_PX
    for k in range(span):
        run &= boundaries.joined[first + k]
    first = first[run]
    off, variance = np.zeros(len(first)), np.zeros(len(first))
    for k, weight in enumerate(weights):
        share = weight - (k == middle)
        off += share * boundaries.position[first + k]
        variance += (share * boundaries.sigma_px[first + k]) ** 2
    return first + middle, off / np.sqrt(variance)
