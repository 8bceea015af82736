"""Where one stripe ends and the next begins, to a fraction of a pixel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import erfinv

from bodyscan.capture.albedo_edges import Brightness
from bodyscan.capture.gray_code import bit_that_flips
from bodyscan.capture.indirect_light import imbalance
from bodyscan.capture.stripe_images import ScanLines

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]

MAX_RATIO = 0.98
TABLE_SIZE = 4096
LEAST_SIGMA_PX = 0.008
"""What blur that is not Gaussian and a sensor that is not quite linear leave, seen in tests."""

MIN_STRIPE_PX = 0.2
FARTHEST_PX = 1.0
"""How far a boundary may lie from where the code changes."""


@dataclass(frozen=True, eq=False)
class Boundaries:
    """Boundaries in the order of scan lines and of places on them.

    line: (N,) scan line.  before: (N,) the pixel before the crossing.  position: (N,) px along the
    line.  line_position: (N,) px, beside the line by a fraction where an edge of brightness pulls
    it.  sigma_px: (N,) standard deviation across the stripes.  index: (N,) boundary i lies between
    stripes i - 1 and i.  joined: (N - 1,) whether the next boundary ends the stripe that this one
    begins.  blur2: px^2, of lens and pixel, see `albedo_edges`.
    """

    line: Ints
    before: Ints
    position: Floats
    line_position: Floats
    sigma_px: Floats
    index: Ints
    joined: Mask
    blur2: float


def find_boundaries(
    images: ScanLines,
    brightness: Brightness,
    codes: NDArray[np.int32],
    usable: Mask,
    variance: NDArray[np.float32],
    finest_run: int = 2,
) -> Boundaries:
    """All places where the code changes by one between two usable pixels of a line.

    Only one bit flips there. Its pattern minus its inverse, divided by lit minus dark (which takes
    out most of the surface's own black and white) and less its `imbalance`, is an error function of
    the distance from the boundary whatever the blur; the inverse error function makes it a straight
    line, whose zero is the boundary. variance: (256,) of each grey level.  finest_run: see `WordCode`.
    """
    change = np.diff(codes, axis=1)
    crossing = (np.abs(change) == 1) & usable[:, 1:] & usable[:, :-1]
    flat = np.flatnonzero(crossing)
    line, before = np.divmod(flat, crossing.shape[1])
    at = line * codes.shape[1] + before
    index = np.maximum(codes.ravel()[at], codes.ravel()[at + 1]).astype(np.int64)
    bit = bit_that_flips(index, len(images.patterns))
    edges = brightness.at(at)
    clear = (index & -index) * finest_run // 2  # stripes: half the way to where the bit flips again
    middle = imbalance(images, codes, usable, variance, bit, index, at, clear)
    left, left_sigma = _straightened(images, variance, bit, at, edges.before, middle)
    right, right_sigma = _straightened(images, variance, bit, at + 1, edges.behind, middle)
    # The code changes where the difference is 0; the boundary may lie beyond these two pixels.
    beyond = np.where(middle[0] != 0.0, FARTHEST_PX, 0.0)
    fraction = np.clip(left / (left - right), -beyond, 1.0 + beyond)
    sigma = np.hypot((1.0 - fraction) * left_sigma, fraction * right_sigma)
    sigma = np.hypot(sigma / np.abs(left - right), LEAST_SIGMA_PX)
    position = before + fraction
    joined = joined_to_next(line, before, position, index, usable)
    blur2 = edges.blur2(position, joined)
    return Boundaries(
        line=line,
        before=before,
        position=position + blur2 * edges.along,
        line_position=line + blur2 * edges.across,
        sigma_px=np.hypot(sigma, edges.doubt(blur2)),
        index=index,
        joined=joined,
        blur2=blur2,
    )


def joined_to_next(line: Ints, before: Ints, position: Floats, index: Ints, usable: Mask) -> Mask:
    """(N - 1,) whether the next boundary ends the stripe that this one begins.

    All pixels between the two must be usable (L, P): where one is not, the surface may end, and
    another that happens to show the next stripe begin.
    """
    joined = (np.diff(line) == 0) & (np.abs(np.diff(index)) == 1)
    joined &= np.diff(position) > MIN_STRIPE_PX
    bad = np.cumsum(~usable.ravel())
    at = line * usable.shape[1] + before
    return joined & (bad[at[1:]] == bad[at[:-1]])


def _straightened(
    images: ScanLines,
    variance: NDArray[np.float32],
    bit: Ints,
    at: Ints,
    contrast: Floats,
    middle: tuple[Floats, Floats],
) -> tuple[Floats, Floats]:
    """Distance from the boundary in units of sqrt(2) blurs (with a sign), and its sigma."""
    difference, noise = images.difference(bit, at, variance)
    ratio = difference / contrast - middle[0]
    scaled = (np.clip(ratio, -MAX_RATIO, MAX_RATIO) / MAX_RATIO + 1.0) * (TABLE_SIZE / 2)
    entry = np.rint(scaled).astype(np.int32)
    return _STRAIGHT[entry], np.hypot(noise / contrast, middle[1]) * _STRETCH[entry]


_RATIOS = np.linspace(-MAX_RATIO, MAX_RATIO, TABLE_SIZE + 1)
_STRAIGHT = erfinv(_RATIOS)
_STRETCH = np.sqrt(np.pi) / 2.0 * np.exp(_STRAIGHT**2)
