"""Several exposures of one stripe sequence merged into one.

A pixel that is not too bright in a longer exposure is less noisy there. Each image of a longer
exposure is brought to the unit of the shortest, short = a + b long, and averaged with it; a and b
are found from the images. Near white an exposure's weight falls gradually, so that there is no
seam. Source: Debevec and Malik, Recovering high dynamic range radiance maps (1997), for a linear
camera.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bodyscan.arrays import Array, Floats, Greys
from bodyscan.errors import ImageError
from bodyscan.geometry.robust import SIGMAS_PER_MEDIAN

FULL, NONE = 215.0, 245.0
"""Grey levels between which an exposure's weight falls to zero: sensors become non-linear below
white."""

DARKEST = 12.0
FEWEST = 1000
MOST_SAMPLED = 200_000
ROUNDS = 4
OUTLYING = 4.0
SHORTER = 0.95
"""Brightness relative to the exposure before, below which the difference is no rounding: the
exposure is the shorter one."""


def merge_exposures(stacks: Sequence[Greys], names: Sequence[str], where: str) -> Floats:
    """Merge exposures into images (F, H, W) float32, in grey levels of the shortest.

    stacks: (F, H, W) grey levels of each exposure, the shortest first, images in equal order.
    names: of the exposures.

    Raises ImageError for exposures that are out of order or cannot be compared.
    """
    lines = [(0.0, 1.0)]
    for place in range(1, len(stacks)):
        offset, slope = _to_before(
            stacks[place - 1], stacks[place], names[place - 1 : place + 1], where
        )
        start, unit = lines[-1]
        lines.append((start + unit * offset, unit * slope))
    merged = np.empty(stacks[0].shape, np.float32)
    for image in range(len(merged)):
        merged[image] = _merged([stack[image] for stack in stacks], lines)
    return merged


def _merged(images: Sequence[Greys], lines: Sequence[tuple[float, float]]) -> Floats:
    """One image (H, W) from its exposures; lines: offset and slope that bring each to the
    shortest."""
    total = images[0].astype(np.float32)
    weights = np.ones_like(total)
    for image, (offset, slope) in zip(images[1:], lines[1:], strict=True):
        level = image.astype(np.float32)
        # The sensor's noise shrinks with the unit: the weight is its inverse variance.
        weight = np.clip((NONE - level) / (NONE - FULL), 0.0, 1.0) / np.float32(slope * slope)
        total += weight * (np.float32(offset) + np.float32(slope) * level)
        weights += weight
    return np.clip(total / weights, 0.0, 255.0)


def _to_before(
    shorter: Greys, longer: Greys, names: Sequence[str], where: str
) -> tuple[float, float]:
    """Offset and slope in shorter = offset + slope * longer."""
    step = max(1, shorter.size // MOST_SAMPLED // 8)
    one, other = (stack.reshape(-1)[::step].astype(float) for stack in (shorter, longer))
    seen = (np.maximum(one, other) > DARKEST) & (np.maximum(one, other) < FULL)
    if np.count_nonzero(seen) < FEWEST:
        raise ImageError(
            f"exposures {names[0]} and {names[1]} cannot be compared: hardly a pixel is neither black "
            "nor white in both",
            where=where,
            remedy="Choose exposures that lie nearer to each other: 2 to 8 times.",
        )
    offset, slope = _line(other[seen], one[seen])
    if slope > 1.0 / SHORTER:
        raise ImageError(
            f"exposure {names[1]} is {1.0 / slope:.2g} times as bright as {names[0]}, which is said to"
            " be the shorter one",
            where=where,
            remedy=f"Name the shortest first: `exposures: [{names[1]}, {names[0]}]`.",
        )
    return offset, slope


def _line(x: Array, y: Array) -> tuple[float, float]:
    """Offset and slope of y against x, without outliers."""
    near = np.ones(len(x), bool)
    slope, offset = 1.0, 0.0
    for _ in range(ROUNDS):
        slope, offset = np.polyfit(x[near], y[near], 1)
        off = np.abs(y - offset - slope * x)
        near = off <= OUTLYING * SIGMAS_PER_MEDIAN * max(float(np.median(off)), 0.1)
    return float(offset), float(slope)
