"""Stripe boundaries to a fraction of a pixel, from the patterns of bits that flip there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.special import erfinv

from bodyscan.arrays import Array, Floats, Indices, Mask
from bodyscan.compiled import compiled
from bodyscan.geometry.robust import SIGMAS_PER_MEDIAN
from bodyscan.stripes.albedo_edges import Brightness
from bodyscan.stripes.scan_lines import ScanLines

MIN_SIGMA_PX = 0.008
"""Error left by blur that is not Gaussian and a sensor that is not quite linear (synthetic images)."""
MIN_STRIPE_PX = 0.2
PARABOLA_RESIDUAL = np.array([-3.0, 12.0, -18.0, 12.0, -3.0]) / 35.0
"""Of five equally spaced values: the fitted parabola (Savitzky and Golay 1964) minus the middle one."""

_MAX_RATIO, _TABLE_SIZE = 0.98, 4096
_RATIOS = np.linspace(-_MAX_RATIO, _MAX_RATIO, _TABLE_SIZE + 1)
_ERFINV = erfinv(_RATIOS)
_ERFINV_SLOPE = np.sqrt(np.pi) / 2.0 * np.exp(_ERFINV**2)


@dataclass(frozen=True, eq=False)
class Boundaries:
    """Boundaries, sorted by scan line and by position along it, (N,) each."""

    line: Indices
    before: Indices  # the pixel before the crossing
    # position, line_position: px along the line, and across lines (off `line` at edges of
    # brightness).
    position: Array
    line_position: Array
    sigma_px: Array  # standard deviation across the stripes
    index: Indices  # boundary i lies between stripes i - 1 and i
    joined: Mask  # (N - 1,) whether the next boundary ends the stripe that this one begins
    blur2: float  # px^2, of lens and pixel, see `albedo_edges`


def find_flipping_bits(boundary: Indices, bits: int) -> Indices:
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
    first: int = 0,
) -> Boundaries:
    """Locate the boundaries wherever the code changes by one between two usable pixels of a line.

    The pattern of the bit that flips minus its inverse, divided by lit minus dark, is an error
    function of the distance from the boundary. The inverse error function turns it into a straight
    line, whose zero is the boundary.

    variance: (256,) of each grey level. first: see `WordCode`.
    """
    pixels = _find_changes(codes, usable)
    line, before = np.divmod(pixels, codes.shape[1])
    index = np.maximum(codes.ravel()[pixels], codes.ravel()[pixels + 1]).astype(np.int64)
    bit = find_flipping_bits(index + first, len(images.patterns))
    edges = brightness.at_boundaries(pixels)
    pairs = np.stack([pixels, pixels + 1], axis=-1)
    fraction, sigma, lever = _find_zeros(
        *images.difference(bit, pairs, variance), np.stack([edges.before, edges.after], axis=-1)
    )
    position = before + fraction
    joined = join_runs(line, before, position, index, usable)
    position -= lever * _estimate_imbalance(position, joined, lever, bit, index)[bit]
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


def _estimate_imbalance(
    position: Array, joined: Mask, lever: Array, bit: Indices, index: Indices
) -> Array:
    """Estimate how much more light reached each bit's pattern than its inverse, shares of lit minus
    dark: lamps flicker, and projectors jitter.

    It moves boundaries one way where the pattern becomes brighter, else the other: least squares on
    distances from the parabola through a boundary and the two on either side. Bits that change in one
    sense only, as in the plain code, get 0.
    """
    size = int(bit.max(initial=0)) + 1
    first = np.flatnonzero(joined[:-3] & joined[1:-2] & joined[2:-1] & joined[3:])
    first = first[:: max(1, len(first) // 30_000)]
    if len(first) < 1000:
        return np.zeros(size)
    rows = np.zeros((len(first), size))
    for k, gain in enumerate(PARABOLA_RESIDUAL):
        rows[np.arange(len(first)), bit[first + k]] += gain * lever[first + k]
    residual = sliding_window_view(position, 5)[first] @ PARABOLA_RESIDUAL
    scatter = SIGMAS_PER_MEDIAN * float(np.median(np.abs(residual)))
    near = np.abs(residual) < 4.0 * scatter
    share = np.bincount(bit, lever > 0.0, size) / np.maximum(np.bincount(bit, minlength=size), 1)
    used = np.flatnonzero(np.abs(share - 0.5) < 0.4)
    rows = rows[near][:, used]
    covariance = np.linalg.pinv(rows.T @ rows)
    found = covariance @ (rows.T @ residual[near])
    # A boundary of a surface that moved is off all along: it counts once.
    once = np.count_nonzero(near) / len(np.unique(index[first[near]]))
    variance = scatter**2 * once * np.diag(covariance)
    # How unequal frames are shows in all bits together (empirical Bayes).
    weights = 1.0 / np.maximum(variance, 1e-12) ** 2
    prior = max(float(np.sum(weights * (found**2 - variance)) / max(weights.sum(), 1e-12)), 0.0)
    result = np.zeros(size)
    result[used] = found * prior / (prior + variance + 1e-12)
    return result


def join_runs(
    line: Indices, before: Indices, position: Array, index: Indices, usable: Mask
) -> Mask:
    """Find whether each boundary's stripe ends at the next boundary, (N - 1,), with all pixels
    between usable (L, P): else another surface that shows the next stripe may begin there."""
    unusable = np.cumsum(~usable.ravel(), dtype=np.int32)[line * usable.shape[1] + before]
    joined = (np.diff(line) == 0) & (np.abs(np.diff(index)) == 1) & (np.diff(unusable) == 0)
    return np.asarray(joined & (np.diff(position) > MIN_STRIPE_PX))


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


def _find_zeros(difference: Floats, noise: Floats, contrast: Array) -> tuple[Array, Array, Array]:
    """Find where the difference is zero, px past the first pixel, its sigma, and by how many px adding
    lit minus dark moves it.

    difference, noise, contrast (lit minus dark): (N, 2) in the pixels before and after it.
    """
    ratio = np.clip(difference / contrast, -_MAX_RATIO, _MAX_RATIO)
    entry = np.rint((ratio / _MAX_RATIO + 1.0) * (_TABLE_SIZE / 2)).astype(np.int64)
    # Signed distances from the boundary in units of sqrt(2) blurs.
    left, right = _ERFINV[entry].T
    share = np.clip(left / (left - right), 0.0, 1.0)
    sigmas = noise / contrast * _ERFINV_SLOPE[entry]
    variance = ((1.0 - share) * sigmas[:, 0]) ** 2 + (share * sigmas[:, 1]) ** 2
    sigma = np.sqrt(variance / (left - right) ** 2 + MIN_SIGMA_PX**2)
    return share, sigma, 0.5 * np.sqrt(np.pi) / (left - right)
