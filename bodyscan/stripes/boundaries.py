"""Where one stripe ends and the next begins, to a fraction of a pixel."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import erfinv

from bodyscan.arrays import Array, Floats, Indices, Mask
from bodyscan.compiled import compiled
from bodyscan.stripes.albedo_edges import Brightness
from bodyscan.stripes.bit_words import bit_that_flips
from bodyscan.stripes.indirect_light import imbalance
from bodyscan.stripes.scan_lines import ScanLines

MAX_RATIO = 0.98
TABLE_SIZE = 4096
LEAST_SIGMA_PX = 0.008
"""Error left by blur that is not Gaussian and a sensor that is not quite linear, found in tests."""

MIN_STRIPE_PX = 0.2
FARTHEST_PX = 1.0
"""How far a boundary may lie from where the code changes."""

_RATIOS = np.linspace(-MAX_RATIO, MAX_RATIO, TABLE_SIZE + 1)
_STRAIGHT = erfinv(_RATIOS)
_STRETCH = np.sqrt(np.pi) / 2.0 * np.exp(_STRAIGHT**2)


@dataclass(frozen=True, eq=False)
class Boundaries:
    """Boundaries, sorted by scan line and by place along it.

    line: (N,) scan line.
    before: (N,) the pixel before the crossing.
    position: (N,) px along the line.
    line_position: (N,) px across lines; a fraction off `line` where an edge of brightness pulls it.
    sigma_px: (N,) standard deviation across the stripes.
    index: (N,) boundary i lies between stripes i - 1 and i.
    joined: (N - 1,) whether the next boundary ends the stripe that this one begins.
    blur2: px^2, of lens and pixel, see `albedo_edges`.
    """

    line: Indices
    before: Indices
    position: Array
    line_position: Array
    sigma_px: Array
    index: Indices
    joined: Mask
    blur2: float

    def where(self, kept: Mask, joined: Mask) -> Boundaries:
        """Those that are kept, (N,); joined: of them, as above."""
        return Boundaries(
            self.line[kept],
            self.before[kept],
            self.position[kept],
            self.line_position[kept],
            self.sigma_px[kept],
            self.index[kept],
            joined,
            self.blur2,
        )


def find_boundaries(
    images: ScanLines,
    brightness: Brightness,
    codes: NDArray[np.int32],
    usable: Mask,
    variance: Floats,
    finest_run: int = 2,
    first: int = 0,
) -> Boundaries:
    """All places where the code changes by one between two usable pixels of a line.

    Only one bit flips there. Its pattern minus its inverse, divided by lit minus dark (which
    removes most of the surface's own black and white) and less its `imbalance`, is an error
    function of the distance from the boundary, whatever the blur; the inverse error function turns
    it into a straight line, whose zero is the boundary.

    variance: (256,) of each grey level.
    finest_run, first: see `WordCode`.
    """
    at = _crossings(codes, usable)
    line, before = np.divmod(at, codes.shape[1])
    index = np.maximum(codes.ravel()[at], codes.ravel()[at + 1]).astype(np.int64)
    number = index + first
    bit = bit_that_flips(number, len(images.patterns))
    edges = brightness.at(at)
    clear = (
        (number & -number) * finest_run // 2
    )  # stripes: half the distance to where the bit flips again
    middle = imbalance(images, codes, usable, variance, bit, index, at, clear)
    beside = np.stack([at, at + 1], axis=-1)
    fraction, sigma = _zeros(
        *images.difference(bit, beside, variance),
        edges.before,
        edges.behind,
        *middle,
    )
    position = before + fraction
    joined = continues_to_next(line, before, position, index, usable)
    blur2 = edges.blur2(position, joined)
    return Boundaries(
        line=line,
        before=before,
        position=position + blur2 * edges.along,
        line_position=line + blur2 * edges.across,
        sigma_px=np.sqrt(sigma**2 + edges.doubt(blur2) ** 2),
        index=index,
        joined=joined,
        blur2=blur2,
    )


def continues_to_next(
    line: Indices, before: Indices, position: Array, index: Indices, usable: Mask
) -> Mask:
    """Whether the next boundary ends the stripe that this one begins, (N - 1,).

    All pixels between the two must be usable (L, P): at one that is not, the surface may end and
    another, which happens to show the next stripe, begin.
    """
    return _joined(line, before, position, index, usable)


@compiled
def _joined(line: Indices, before: Indices, position: Array, index: Indices, usable: Mask) -> Mask:
    joined = np.zeros(max(line.size - 1, 0), np.bool_)
    for k in range(joined.size):
        if line[k + 1] != line[k] or abs(index[k + 1] - index[k]) != 1:
            continue
        whole = position[k + 1] - position[k] > MIN_STRIPE_PX
        for place in range(before[k] + 1, before[k + 1] + 1):
            whole &= usable[line[k], place]
        joined[k] = whole
    return joined


@compiled
def _crossings(codes: NDArray[np.int32], usable: Mask) -> Indices:
    """Flat pixels (N,), usable like the next on their line, whose codes differ by one."""
    found, count = np.empty(codes.size, np.int64), 0
    for line in range(codes.shape[0]):
        if not usable[line].any():
            continue
        for place in range(codes.shape[1] - 1):
            # Without a branch: on a noisy image a processor mispredicts every other one.
            found[count] = line * codes.shape[1] + place
            step = abs(codes[line, place + 1] - codes[line, place])
            count += usable[line, place] & usable[line, place + 1] & (step == 1)
    return found[:count].copy()


@compiled
def _zeros(
    difference: Floats,
    noise: Floats,
    before: Array,
    behind: Array,
    middle: Array,
    middle_sigma: Array,
) -> tuple[Array, Array]:
    """Where the difference takes its middle value, in px after the pixel before it, and its sigma.

    difference, noise: (N, 2) in the pixels before and behind.
    before, behind: (N,) lit minus dark.
    """
    fraction, sigma = np.empty(before.size), np.empty(before.size)
    for k in range(before.size):
        left, left_sigma = _straightened(
            difference[k, 0], noise[k, 0], before[k], middle[k], middle_sigma[k]
        )
        right, right_sigma = _straightened(
            difference[k, 1], noise[k, 1], behind[k], middle[k], middle_sigma[k]
        )
        # The code changes where the difference is 0; the boundary may lie beyond these two pixels.
        beyond = FARTHEST_PX if middle[k] != 0.0 else 0.0
        share = min(max(left / (left - right), -beyond), 1.0 + beyond)
        doubt2 = ((1.0 - share) * left_sigma) ** 2 + (share * right_sigma) ** 2
        fraction[k] = share
        sigma[k] = math.sqrt(doubt2 / (left - right) ** 2 + LEAST_SIGMA_PX**2)
    return fraction, sigma


@compiled
def _straightened(
    difference: float, noise: float, contrast: float, middle: float, middle_sigma: float
) -> tuple[float, float]:
    """Signed distance from the boundary in units of sqrt(2) blurs, and its sigma."""
    ratio = min(max(difference / contrast - middle, -MAX_RATIO), MAX_RATIO)
    entry = int(np.rint((ratio / MAX_RATIO + 1.0) * (TABLE_SIZE / 2)))
    doubt = math.sqrt((noise / contrast) ** 2 + middle_sigma**2)
    return _STRAIGHT[entry], doubt * _STRETCH[entry]
