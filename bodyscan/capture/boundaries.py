"""Where one stripe ends and the next begins, to a fraction of a pixel, and s in between."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import erfinv

from bodyscan.capture.stripe_images import StripeImages

Floats = NDArray[np.float32]
Ints = NDArray[np.int64]

TABLE_SIZE = 4096
MAX_RATIO = 0.98


@dataclass(frozen=True, eq=False)
class Boundaries:
    """Crossings in the order of lines and positions.

    line: (N,) scan line.  before: (N,) the pixel before the crossing.  position: (N,) float64, px
    along the line.  index: (N,) boundary i lies between stripes i - 1 and i.  rises: (N,) whether
    s increases with position.  sigma_px: (N,) float32.
    """

    line: Ints
    before: Ints
    position: NDArray[np.float64]
    index: Ints
    rises: NDArray[np.bool_]
    sigma_px: Floats


def find_boundaries(
    images: StripeImages,
    codes: NDArray[np.int32],
    usable: NDArray[np.bool_],
    noise: float,
) -> Boundaries:
    """All places where the code changes by one between two usable pixels of a line.

    Only one bit flips there. Its pattern minus its inverse, divided by their sum above the dark
    (which takes out the surface's own black and white), is an error function of the distance
    from the boundary whatever the blur; the inverse error function makes it a straight line,
    whose zero is the boundary.
    """
    change = np.diff(codes, axis=1)
    crossing = (np.abs(change) == 1) & usable[:, 1:] & usable[:, :-1]
    line, before = np.nonzero(crossing)
    rises = change[line, before] > 0
    index = codes[line, before].astype(np.int64) + rises
    bit = len(images.patterns) - 1 - _trailing_zeros(index)
    left, left_sum = _ratio(images, bit, line, before)
    right, right_sum = _ratio(images, bit, line, before + 1)
    a, b = _straighten(left), _straighten(right)
    fraction = np.clip(a / (a - b), 0.0, 1.0)
    slope = np.abs(right - left)
    grey = np.minimum(left_sum, right_sum)
    sigma = np.sqrt(2.0) * noise / np.maximum(grey, 1.0) / np.maximum(slope, 0.05)
    return Boundaries(line, before, before + fraction, index, rises, sigma.astype(np.float32))


def _trailing_zeros(index: Ints) -> Ints:
    """Position of the lowest bit set; index > 0. Boundary i flips that bit of the Gray code."""
    return np.frexp((index & -index).astype(float))[1].astype(np.int64) - 1


def _ratio(images: StripeImages, bit: Ints, line: Ints, position: Ints) -> tuple[Floats, Floats]:
    """(pattern - inverse) / (pattern + inverse - 2 dark), and that sum."""
    pattern = images.patterns[bit, line, position].astype(np.float32)
    inverse = images.inverses[bit, line, position].astype(np.float32)
    total = np.maximum(pattern + inverse - 2.0 * images.dark[line, position], 1.0)
    return (pattern - inverse) / total, total


_TABLE = erfinv(np.linspace(-MAX_RATIO, MAX_RATIO, TABLE_SIZE + 1)).astype(np.float32)


def _straighten(ratio: Floats) -> Floats:
    """Inverse error function, from a table."""
    scaled = (np.clip(ratio, -MAX_RATIO, MAX_RATIO) / MAX_RATIO + 1.0) * (TABLE_SIZE / 2)
    return _TABLE[np.rint(scaled).astype(np.int32)]


def interpolate_stripes(
    boundaries: Boundaries, codes: NDArray[np.int32], usable: NDArray[np.bool_]
) -> tuple[Floats, Floats]:
    """s and its standard deviation (L, P), NaN where there is none."""
    shape = codes.shape
    crossing = np.zeros(shape, bool)
    crossing[boundaries.line, boundaries.before] = True
    last = np.cumsum(crossing.ravel(), dtype=np.int32).reshape(shape) - crossing - 1
    step = np.diff(boundaries.index)
    width = np.diff(boundaries.position)
    joined = (np.abs(step) == 1) & (np.diff(boundaries.line) == 0) & (width > 0.2)
    slope = np.where(joined, step / np.where(joined, width, 1.0), np.nan)
    offset = boundaries.index[:-1] - slope * boundaries.position[:-1]
    variance = boundaries.sigma_px.astype(float) ** 2
    spread = np.abs(slope) * np.sqrt((variance[:-1] + variance[1:]) / 2)
    slope, offset, spread = (
        np.append(value, np.nan).astype(np.float64) for value in (slope, offset, spread)
    )
    pixel = np.arange(shape[1], dtype=np.float32)
    s = (offset[last] + slope[last] * pixel).astype(np.float32)
    wrong = ~usable | (np.abs(s - codes - 0.5) > 0.6)
    s[wrong] = np.nan
    sigma = spread[last].astype(np.float32)
    sigma[np.isnan(s)] = np.nan
    return s, sigma
