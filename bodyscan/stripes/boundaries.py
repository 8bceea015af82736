"""Stripe boundaries to a fraction of a pixel, from the patterns of bits that flip there."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import erfinv

from bodyscan.arrays import Array, Floats, Greys, Indices, Mask
from bodyscan.compiled import compiled
from bodyscan.stripes.albedo_edges import Brightness
from bodyscan.stripes.scan_lines import ScanLines

MIN_SIGMA_PX = 0.008
"""Error left by blur that is not Gaussian and a sensor that is not quite linear (synthetic images)."""
MIN_STRIPE_PX = 0.2

_MAX_RATIO, _TABLE_SIZE = 0.98, 4096
_RATIOS = np.linspace(-_MAX_RATIO, _MAX_RATIO, _TABLE_SIZE + 1)
_ERFINV = erfinv(_RATIOS)
_ERFINV_SLOPE = np.sqrt(np.pi) / 2.0 * np.exp(_ERFINV**2)
_NEIGHBOURS_PX = (3, 4, 5, 6)
"""Distances from the two pixels around a boundary to those that are clear of its blur."""


@dataclass(frozen=True, eq=False)
class Boundaries:
    """Boundaries, sorted by scan line and by position along it, (N,) each.

    before: the pixel before the crossing.
    position, line_position: px along the line, and across lines (off `line` at edges of
        brightness).
    sigma_px: standard deviation across the stripes.
    index: boundary i lies between stripes i - 1 and i.
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


def bit_that_flips(boundary: Indices, bits: int) -> Indices:
    """Compute which bit (0 the most significant) flips at boundary i > 0; in the plain code,
    where several flip, the coarsest."""
    lowest_set = np.frexp((boundary & -boundary).astype(np.float64))[1].astype(np.int64) - 1
    return bits - 1 - lowest_set


def find_boundaries(
    images: ScanLines,
    brightness: Brightness,
    codes: NDArray[np.int32],
    usable: Mask,
    variance: Floats,
    finest_run: int = 2,
    first: int = 0,
) -> Boundaries:
    """Locate the boundaries wherever the code changes by one between two usable pixels of a line.

    The pattern of the bit that flips minus its inverse, divided by lit minus dark and less its
    imbalance by indirect light, is an error function of the distance from the boundary. The inverse
    error function turns it into a straight line, whose zero is the boundary.

    variance: (256,) of each grey level. finest_run, first: see `WordCode`.
    """
    pixels = _find_changes(codes, usable)
    line, before = np.divmod(pixels, codes.shape[1])
    index = np.maximum(codes.ravel()[pixels], codes.ravel()[pixels + 1]).astype(np.int64)
    number = index + first
    bit = bit_that_flips(number, len(images.patterns))
    edges = brightness.at_boundaries(pixels)
    # Half the distance, in stripes, to where the bit flips again.
    reach = (number & -number) * finest_run // 2
    imbalance = measure_imbalance(images, codes, usable, variance, bit, index, pixels, reach)
    pairs = np.stack([pixels, pixels + 1], axis=-1)
    fraction, sigma = _find_zeros(
        *images.difference(bit, pairs, variance), edges.before, edges.behind, *imbalance
    )
    position = before + fraction
    joined = join_runs(line, before, position, index, usable)
    blur2 = edges.estimate_blur2(position, joined)
    return Boundaries(
        line=line,
        before=before,
        position=position + blur2 * edges.along,
        line_position=line + blur2 * edges.across,
        sigma_px=np.sqrt(sigma**2 + edges.shift_sigma(blur2) ** 2),
        index=index,
        joined=joined,
        blur2=blur2,
    )


@compiled
def join_runs(
    line: Indices, before: Indices, position: Array, index: Indices, usable: Mask
) -> Mask:
    """Find whether each boundary's stripe ends at the next boundary, (N - 1,), with all pixels
    between usable (L, P): else another surface that happens to show the next stripe may begin
    there."""
    joined = np.zeros(max(line.size - 1, 0), np.bool_)
    for k in range(joined.size):
        if line[k + 1] != line[k] or abs(index[k + 1] - index[k]) != 1:
            continue
        whole = position[k + 1] - position[k] > MIN_STRIPE_PX
        for x in range(before[k] + 1, before[k + 1] + 1):
            whole &= usable[line[k], x]
        joined[k] = whole
    return joined


@compiled
def _find_changes(codes: NDArray[np.int32], usable: Mask) -> Indices:
    """Flat pixels (N,), usable like the next on their line, whose codes differ by one."""
    pixels, count = np.empty(codes.size, np.int64), 0
    for line in range(codes.shape[0]):
        if not usable[line].any():
            continue
        for x in range(codes.shape[1] - 1):
            # Without a branch: on a noisy image a processor mispredicts every other one.
            pixels[count] = line * codes.shape[1] + x
            step = abs(codes[line, x + 1] - codes[line, x])
            count += usable[line, x] & usable[line, x + 1] & (step == 1)
    return pixels[:count].copy()


@compiled
def _find_zeros(
    difference: Floats,
    noise: Floats,
    before: Array,
    behind: Array,
    imbalance: Array,
    imbalance_sigma: Array,
) -> tuple[Array, Array]:
    """Find where the difference equals the imbalance, px behind the first pixel, and its sigma.

    difference, noise: (N, 2) in the pixels before and behind; before, behind: lit minus dark.
    """
    fraction, sigma = np.empty(before.size), np.empty(before.size)
    for k in range(before.size):
        left, left_sigma = _linearize(
            difference[k, 0], noise[k, 0], before[k], imbalance[k], imbalance_sigma[k]
        )
        right, right_sigma = _linearize(
            difference[k, 1], noise[k, 1], behind[k], imbalance[k], imbalance_sigma[k]
        )
        # The code changes where the difference is 0; the boundary may lie beyond these two pixels.
        beyond = 1.0 if imbalance[k] != 0.0 else 0.0
        share = min(max(left / (left - right), -beyond), 1.0 + beyond)
        variance = ((1.0 - share) * left_sigma) ** 2 + (share * right_sigma) ** 2
        fraction[k] = share
        sigma[k] = math.sqrt(variance / (left - right) ** 2 + MIN_SIGMA_PX**2)
    return fraction, sigma


@compiled
def _linearize(
    difference: float, noise: float, contrast: float, imbalance: float, imbalance_sigma: float
) -> tuple[float, float]:
    """Compute the signed distance from the boundary in units of sqrt(2) blurs, and its sigma."""
    ratio = min(max(difference / contrast - imbalance, -_MAX_RATIO), _MAX_RATIO)
    entry = int(np.rint((ratio / _MAX_RATIO + 1.0) * (_TABLE_SIZE / 2)))
    sigma = math.sqrt((noise / contrast) ** 2 + imbalance_sigma**2)
    return _ERFINV[entry], sigma * _ERFINV_SLOPE[entry]


def measure_imbalance(
    images: ScanLines,
    codes: NDArray[np.int32],
    usable: Mask,
    variance: Floats,
    bit: Indices,
    index: Indices,
    pixels: Indices,
    reach: Indices,
) -> tuple[Array, Array]:
    """Measure the imbalance J / (D + I) at boundaries `index` (N,) of `bit` (N,), and its sigma.

    With direct light D and indirect light I, a pattern minus its inverse is +-D + J; J, the part of
    I that differs between the two, is up to I for broad stripes (Nayar et al. 2006). The boundary
    lies where the difference is J, the mean of the values on both sides.

    pixels: (N,) flat pixels before the boundaries.
    reach: (N,) number of stripes on either side in which the bit surely keeps its value.

    0 where noise may explain it, and for the finest bit, which has no room next to its boundaries.
    """
    mean, sigma = np.zeros(len(pixels)), np.zeros(len(pixels))
    wide = np.flatnonzero(reach >= 2)
    # In blocks whose values fit into a processor's cache.
    for some in np.array_split(wide, 1 + len(wide) // 16384):
        around = _find_neighbours(codes, usable, pixels[some], index[some], reach[some])
        difference, noise = images.difference(bit[some], around, variance)
        mean[some], sigma[some] = _average_imbalance(
            images.lit.ravel(), images.dark.ravel(), around, difference, noise
        )
    return mean, sigma


@compiled
def _find_neighbours(
    codes: NDArray[np.int32], usable: Mask, pixels: Indices, index: Indices, reach: Indices
) -> Indices:
    """Flat pixels (N, 8) on both sides of boundaries, clear of their blur and of the bit's next
    flips; -1 for both if one is not."""
    width = codes.shape[1]
    around = np.full((pixels.size, 2 * len(_NEIGHBOURS_PX)), -1)
    for k in range(pixels.size):
        line, x = divmod(pixels[k], width)
        for n, step in enumerate(_NEIGHBOURS_PX):
            left, right = x - step, x + 1 + step
            if left < 0 or right >= width or not (usable[line, left] and usable[line, right]):
                continue
            before, behind = codes[line, left] + 0.5 - index[k], codes[line, right] + 0.5 - index[k]
            if before * behind < 0.0 and max(abs(before), abs(behind)) < reach[k]:
                around[k, 2 * n], around[k, 2 * n + 1] = line * width + left, line * width + right
    return around


@compiled
def _average_imbalance(
    lit: Greys, dark: Greys, around: Indices, difference: Floats, noise: Floats
) -> tuple[Array, Array]:
    """Imbalance and its sigma (N,) from differences (N, K) around each boundary."""
    result, sigma = np.zeros(len(around)), np.zeros(len(around))
    for k in range(len(around)):
        total, size, noise2, count = 0.0, 0.0, 0.0, 0
        for n in range(around.shape[1]):
            pixel = around[k, n]
            if pixel < 0:
                continue
            contrast = max(np.float64(lit[pixel]) - np.float64(dark[pixel]), 0.02)
            total += difference[k, n] / contrast
            size += abs(difference[k, n]) / contrast
            noise2 += (noise[k, n] / contrast) ** 2
            count += 1
        if count:
            indirect = max(1.0 - size / count, 0.0)
            mean = min(max(total / count, -indirect), indirect)  # |J| <= I
            variance = noise2 / count**2
            # Shrunk towards zero if it is no more than some 4 sigmas; known to 30 % at best.
            kept = mean * mean**2 / (mean**2 + 4.0**2 * variance + 1e-12)
            by_noise = min(math.sqrt(variance), abs(kept))
            result[k] = kept
            sigma[k] = math.sqrt(by_noise**2 + (0.3 * kept) ** 2)
    return result, sigma
