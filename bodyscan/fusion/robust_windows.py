"""Robust quadratic fits in single windows of an image, for pixels near rims, holes and jumps.

Trimmed least squares: each fit is repeated with the samples close to the previous one. Many windows
are fitted side by side, so that every operation runs along memory.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bodyscan.arrays import Array, Floats, Mask
from bodyscan.compiled import compiled

LANES = 128  # windows fitted side by side: as many as fit into a processor's cache
ROUNDS_SIGMAS = (8.0, 3.0)  # how close samples must be to the previous fit
OWN_SIGMAS = 4.0  # a pixel farther than this off its own fit is not on the surface
FIRST_RADIUS_PX = 2.5
SHARPEST_RADIUS_MM = 6.0  # prior: surfaces rarely curve more tightly than this
FEWEST_SAMPLES = 15
ZERO, ONE, FOUR = np.float32(0.0), np.float32(1.0), np.float32(4.0)
FAR = np.float32(1e6)  # sigmas off: not part of the surface

# A quadratic has six terms du^U dv^V. Its normal equations consist of 21 moments: sums over the
# samples of du^i dv^j, i + j < 5, and then of du^i dv^j times the sample, i + j < 3.
U, V = (0, 1, 0, 2, 1, 0), (0, 0, 1, 0, 1, 2)
POWERS = [(i, j) for i in range(5) for j in range(5 - i)]
LOW_POWERS = [(i, j) for i in range(3) for j in range(3 - i)]
LEFT = np.array([[POWERS.index((U[a] + U[b], V[a] + V[b])) for b in range(6)] for a in range(6)])
RIGHT = np.array([len(POWERS) + LOW_POWERS.index(power) for power in zip(U, V, strict=True)])


@compiled
def fit_windows(
    padded: Floats,
    noise: Floats,
    pixels: NDArray[np.intp],
    reach: int,
    pixel_mm: float,
    fits: tuple[Floats, Floats, Floats, Floats],
    fitted: Mask,
) -> None:
    """Fit a quadratic at some pixels to whatever in the window lies on the same surface.

    padded: inverse depths (h + 2 reach, w + 2 reach), 0 where nothing was measured and all round.
    noise: their standard deviation, (h, w).
    pixels: flat indices of measured pixels.
    reach: windows have 2 reach + 1 pixels a side.
    pixel_mm: width of a pixel on the surface.
    fits: value, slopes per column and row, and sigma, (h, w), filled in at the pixels.
    fitted: (h, w), set true there if the pixel lies on its own fit with enough other samples.

    Starts with the closest neighbours, which recognise a step beside them; a weak prior on the
    second derivatives keeps one-sided windows stable.
    """
    count = (2 * reach + 1) ** 2
    samples, weights = np.zeros((count, LANES), np.float32), np.zeros((count, LANES), np.float32)
    moments, solution = np.empty((21, LANES)), np.empty((6, LANES))
    variance, prior = np.ones(LANES), np.ones(LANES)
    own, unit = np.ones(LANES, np.float32), np.ones(LANES, np.float32)
    step = np.ones(LANES, np.float32)
    for start in range(0, len(pixels), LANES):
        block = pixels[start : start + LANES]  # unused lanes of the last block do not matter
        _gather(padded, block, reach, samples)
        for b, pixel in enumerate(block):
            own[b], unit[b] = samples[count // 2, b], noise.ravel()[pixel]
            step[b] = pixel_mm * own[b] * own[b] / unit[b]  # a pixel's width, over the noise
            prior[b] = (step[b] * pixel_mm / (2.0 * SHARPEST_RADIUS_MM)) ** -2.0
        _begin(samples, own, unit, step, reach, weights)
        for width in ROUNDS_SIGMAS:
            _sum(samples, weights, reach, moments)
            _solve(moments, prior, solution, variance)
            _reweigh(samples, solution, reach, width, weights)
        _sum(samples, weights, reach, moments)
        _solve(moments, prior, solution, variance)
        for b, pixel in enumerate(block):
            fits[0].ravel()[pixel] = own[b] + solution[0, b] * unit[b]
            fits[1].ravel()[pixel] = solution[1, b] * unit[b]
            fits[2].ravel()[pixel] = solution[2, b] * unit[b]
            fits[3].ravel()[pixel] = np.sqrt(variance[b]) * unit[b]
            close = abs(solution[0, b]) < OWN_SIGMAS and variance[b] < 1.0
            fitted.ravel()[pixel] = close and moments[0, b] >= FEWEST_SAMPLES


@compiled
def _gather(padded: Floats, pixels: NDArray[np.intp], reach: int, samples: Floats) -> None:
    """Gather the samples of the windows, (samples, LANES), one window after another."""
    side, width = 2 * reach + 1, padded.shape[1] - 2 * reach
    for b in range(len(pixels)):
        row, column = pixels[b] // width, pixels[b] % width
        for r in range(side):
            for c in range(side):
                samples[r * side + c, b] = padded[row + r, column + c]


@compiled
def _begin(
    samples: Floats, own: Floats, unit: Floats, step: Floats, reach: int, weights: Floats
) -> None:
    """Subtract the centre's sample and divide by its noise; set the first weights.

    Samples that cannot be on the centre's surface become FAR; weights are 1 for the closest others.
    """
    n = 0
    for dv in range(-reach, reach + 1):
        for du in range(-reach, reach + 1):
            distance = np.float32(np.sqrt(du * du + dv * dv))
            _weigh_first(samples[n], own, unit, step, distance, weights[n])
            n += 1


@compiled
def _weigh_first(
    sample: Floats, own: Floats, unit: Floats, step: Floats, distance: np.float32, weight: Floats
) -> None:
    """`_begin` for one pixel of the windows, `distance` from their centres."""
    first = ONE if distance < FIRST_RADIUS_PX else ZERO
    for b in range(len(sample)):
        off = (sample[b] - own[b]) / unit[b]
        # Four sigmas, plus as much as the steepest useful surface rises.
        near = (sample[b] > ZERO) & (abs(off) < FOUR + FOUR * step[b] * distance)
        sample[b] = off if near else FAR
        weight[b] = first if near else ZERO


@compiled
def _sum(samples: Floats, weights: Floats, reach: int, moments: Array) -> None:
    """Moments (21, LANES) of the windows, summed row by row."""
    rows, product = np.empty((8, LANES), np.float32), np.empty(LANES, np.float32)
    moments[:] = 0.0
    n = 0
    for dv in range(-reach, reach + 1):
        rows[:] = 0.0
        for du in range(-reach, reach + 1):
            _multiply(weights[n], samples[n], product)
            power = ONE
            for i in range(5):
                _add(rows[i], power, weights[n])
                if i < 3:
                    _add(rows[5 + i], power, product)
                power = power * np.float32(du)
            n += 1
        k = 0
        for i in range(8):
            height = 1.0
            for _ in range(5 - i if i < 5 else 8 - i):
                _add(moments[k], height, rows[i])
                k, height = k + 1, height * dv


@compiled
def _solve(moments: Array, prior: Array, solution: Array, variance: Array) -> None:
    """Solve for the six coefficients and the first's variance. prior: ridge on the last three.

    Gaussian elimination from the last unknown to the second; the first one's pivot is then its
    inverse variance. The matrix is positive definite, so no pivoting is needed.
    """
    normal, factor = np.empty((6, 6, LANES)), np.empty(LANES)
    for i in range(6):
        _copy(moments[RIGHT[i]], solution[i])
        for j in range(i, 6):
            _copy(moments[LEFT[i, j]], normal[i, j])
        for b in range(LANES):
            normal[i, i, b] += prior[b] if i >= 3 else 1e-6
    for k in range(5, 0, -1):
        for i in range(k):
            _divide(normal[i, k], normal[k, k], factor)
            _subtract(solution[i], factor, solution[k])
            for j in range(i, k):
                _subtract(normal[i, j], factor, normal[j, k])
    for i in range(6):
        for k in range(i):
            _subtract(solution[i], normal[k, i], solution[k])
        _divide(solution[i], normal[i, i], solution[i])
    for b in range(LANES):
        variance[b] = 1.0 / normal[0, 0, b]


@compiled
def _reweigh(samples: Floats, solution: Array, reach: int, width: float, weights: Floats) -> None:
    """Set weights to 1 for samples within `width` of the fits, 0 for the others."""
    a, b, c, d, e, f = [solution[k].astype(np.float32) for k in range(6)]
    n = 0
    for dv in range(-reach, reach + 1):
        v = np.float32(dv)
        constant, slope = a + v * (c + v * f), b + v * e
        for du in range(-reach, reach + 1):
            _weigh(samples[n], constant, slope, d, np.float32(du), np.float32(width), weights[n])
            n += 1


@compiled
def _weigh(
    sample: Floats,
    constant: Floats,
    slope: Floats,
    curvature: Floats,
    du: np.float32,
    width: np.float32,
    weight: Floats,
) -> None:
    """`_reweigh` for one pixel of the windows, each of which has its quadratic in du."""
    for b in range(len(sample)):
        off = sample[b] - (constant[b] + du * (slope[b] + du * curvature[b]))
        weight[b] = ONE if abs(off) < width else ZERO


@compiled
def _copy(one: Array, other: Array) -> None:
    for b in range(len(other)):
        other[b] = one[b]


@compiled
def _add(total: Floats | Array, factor: float | np.float32, part: Floats) -> None:
    for b in range(len(total)):
        total[b] += factor * part[b]


@compiled
def _subtract(total: Array, factor: Array, part: Array) -> None:
    for b in range(len(total)):
        total[b] -= factor[b] * part[b]


@compiled
def _multiply(one: Floats, other: Floats, product: Floats) -> None:
    for b in range(len(product)):
        product[b] = one[b] * other[b]


@compiled
def _divide(one: Array, other: Array, quotient: Array) -> None:
    for b in range(len(quotient)):
        quotient[b] = one[b] / other[b]
