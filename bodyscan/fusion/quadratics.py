"""Local quadratic fits to an image of inverse depths, full windows fast and the others robustly.

Savitzky and Golay (1964), in two dimensions. Where a window is full, the fit is a handful of fixed
convolutions; at rims, holes and jumps in depth it is a robust least-squares fit to the pixels that
belong to the same surface.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from bodyscan.fusion.grid import Floats, product

Mask = NDArray[np.bool_]

ROBUST_SIGMAS = 3.0
OUTLIER_SIGMAS = 5.0
FIRST_RADIUS_PX = 2.5
NORMAL_MEDIAN = 0.6745  # of the absolute value of a standard normal variable
SHARPEST_RADIUS_MM = 6.0  # prior: surfaces curve more tightly than this only now and then
FEWEST_SAMPLES = 15
BLOCK = 4096  # windows fitted at a time: what fits into a processor's cache


@dataclass(frozen=True, eq=False)
class Fit:
    """Per pixel: smoothed inverse depth, its slope per column and row, its standard deviation."""

    value: Floats
    slope_u: Floats
    slope_v: Floats
    sigma: Floats


def fit_quadratics(
    inverse: Floats, noise: Floats, valid: Mask, reach: int, pixel_mm: float
) -> tuple[Fit, Mask]:
    """Fits to an inverse depth of standard deviation `noise`, and at which pixels they succeed.

    The noise is believed to be in proportion to `noise`; its size is taken from the residuals,
    where they are larger.
    """
    closed, whole = with_holes_closed(inverse, valid)
    fit = convolved_fit(closed, reach)
    window = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    full = valid & (cv2.erode(whole.astype(np.uint8), window, borderValue=0) > 0)
    residual = np.where(valid, (inverse - fit.value) / np.where(valid, noise, 1.0), 0.0)
    if full.any():
        # A residual lacks the share of its own noise that the fit took up.
        own_share = float(fit.sigma[0, 0]) ** 2
        typical = float(np.median(np.abs(residual[full]))) / np.sqrt(1.0 - own_share)
        size = np.float32(max(1.0, typical / NORMAL_MEDIAN))
        noise, residual = noise * size, residual / size
    np.multiply(fit.sigma, noise, out=fit.sigma)
    misfit = cv2.boxFilter(residual * residual, -1, (5, 5), borderType=cv2.BORDER_CONSTANT)
    calm = (whole & (np.abs(residual) < OUTLIER_SIGMAS)).astype(np.uint8)
    easy = valid & (misfit < 4.0) & (cv2.erode(calm, window, borderValue=0) > 0)
    hard = np.flatnonzero(valid & ~easy)
    values, good = robust_fit(inverse, noise, valid, hard, reach, pixel_mm)
    for field, value in zip(
        (fit.value, fit.slope_u, fit.slope_v, fit.sigma), values.T, strict=True
    ):
        field.ravel()[hard] = value
    easy.ravel()[hard] = good
    return fit, easy


def with_holes_closed(inverse: Floats, valid: Mask) -> tuple[Floats, Mask]:
    """With values in holes of a few pixels, so that they do not spoil the windows around them.

    The mean of opposite neighbours up to two pixels away, exact on a plane; at least four of the
    twelve opposite pairs must be there.
    """
    known = valid.astype(np.uint8)
    around = cv2.boxFilter(known, -1, (5, 5), normalize=False, borderType=cv2.BORDER_CONSTANT)
    holes = np.flatnonzero(~valid & (around >= 8))
    width = inverse.shape[1] + 4
    padded = np.pad(np.where(valid, inverse, 0.0), 2).ravel()
    centres = holes + 4 * (holes // inverse.shape[1]) + 2 * width + 2
    steps = np.array([r * width + c for r in range(3) for c in range(-2, 3) if r > 0 or c > 0])
    one, other = padded[centres[:, None] + steps], padded[centres[:, None] - steps]
    both = (one > 0) & (other > 0)
    count = both.sum(axis=1)
    total = np.sum(np.where(both, one + other, 0.0), axis=1)
    found = count >= 4
    closed, whole = inverse.copy(), valid.copy()
    closed.ravel()[holes[found]] = total[found] / (2.0 * count[found])
    whole.ravel()[holes[found]] = True
    return closed, whole


def convolved_fit(inverse: Floats, reach: int) -> Fit:
    """The quadratic fit of full windows, as separable convolutions; sigma for a noise of 1."""
    offsets = np.arange(-reach, reach + 1, dtype=float)
    basis = window_basis(reach)
    normal = np.linalg.inv(basis.T @ basis)
    one, slope, square = np.ones_like(offsets), offsets, offsets**2

    def filtered(rows: NDArray[np.float64], columns: NDArray[np.float64]) -> Floats:
        return cv2.sepFilter2D(inverse, cv2.CV_32F, columns, rows, borderType=cv2.BORDER_CONSTANT)

    constant, along_u2, along_v2 = normal[0, 0], normal[0, 3], normal[0, 5]
    value = filtered(one, constant * one + along_u2 * square) + filtered(along_v2 * square, one)
    sigma = np.full_like(inverse, np.sqrt(constant))
    return Fit(
        value, filtered(one, normal[1, 1] * slope), filtered(normal[2, 2] * slope, one), sigma
    )


def window_basis(reach: int) -> NDArray[np.float64]:
    """(samples, 6): 1, du, dv, du^2, du dv, dv^2 over a square window, row by row."""
    dv, du = np.mgrid[-reach : reach + 1, -reach : reach + 1].reshape(2, -1).astype(float)
    return np.stack([np.ones_like(du), du, dv, du * du, du * dv, dv * dv], axis=-1)


def robust_fit(
    inverse: Floats,
    noise: Floats,
    valid: Mask,
    pixels: NDArray[np.intp],
    reach: int,
    pixel_mm: float,
) -> tuple[Floats, Mask]:
    """Fits at some pixels (flat indices) to whatever in the window lies on the same surface.

    Iteratively reweighted, beginning with the neighbours in depth; a weak prior on the second
    derivatives keeps one-sided windows calm. Returns value, slopes and sigma (n, 4), and which
    pixels lie on their own fit with enough company.
    """
    # A margin of zeros (nothing measured) all round, so that every window is whole.
    padded = np.pad(np.where(valid, inverse, 0.0), reach)
    rows, columns = np.divmod(pixels, inverse.shape[1])
    centres = (rows + reach) * padded.shape[1] + columns + reach
    dv, du = np.mgrid[-reach : reach + 1, -reach : reach + 1].reshape(2, -1)
    offsets = dv * padded.shape[1] + du
    results = np.empty((pixels.size, 4), np.float32)
    good = np.empty(pixels.size, bool)
    for start in range(0, pixels.size, BLOCK):
        block = slice(start, start + BLOCK)
        samples = padded.ravel()[centres[block, None] + offsets]
        own_noise = noise.ravel()[pixels[block]]
        results[block], good[block] = _fit_windows(samples, own_noise, reach, pixel_mm)
    return results, good


def _fit_windows(
    samples: Floats, own_noise: Floats, reach: int, pixel_mm: float
) -> tuple[Floats, Mask]:
    """`robust_fit` for windows (n, samples) of inverse depth, 0 where nothing was measured."""
    basis = window_basis(reach).astype(np.float32)
    distance = np.hypot(basis[:, 1], basis[:, 2])
    present = samples > 0
    own = samples[:, samples.shape[1] // 2].copy()
    # In units of the pixel's own noise, so that one prior and one threshold serve everywhere.
    samples = (samples - own[:, None]) / own_noise[:, None]
    step = pixel_mm * own**2 / own_noise  # one pixel's width, seen as inverse depth over noise
    curvature = step * pixel_mm / (2.0 * SHARPEST_RADIUS_MM)
    candidates = present & (np.abs(samples) < 4.0 + 4.0 * step[:, None] * distance)
    # First the closest neighbours, which see a step beside them for what it is.
    weights = (candidates & (distance < FIRST_RADIUS_PX)).astype(np.float32)
    for width in (8.0, 4.0, ROBUST_SIGMAS):
        solution, variance = _solve(weights, samples, basis, curvature)
        close = np.abs(samples - product(solution, basis.T)) < width
        weights = (candidates & close).astype(np.float32)
    solution, variance = _solve(weights, samples, basis, curvature)
    sigma = np.sqrt(variance)
    good = (np.abs(solution[:, 0]) < 4.0) & (weights.sum(axis=1) >= FEWEST_SAMPLES) & (sigma < 1.0)
    scaled = np.concatenate([solution[:, :3], sigma[:, None]], axis=1) * own_noise[:, None]
    scaled[:, 0] += own
    return scaled, good


def _solve(
    weights: Floats, samples: Floats, basis: Floats, curvature: Floats
) -> tuple[Floats, Floats]:
    """Weighted ridge solutions (n, 6) and the variance (n,) of their first coefficient.

    Gauss and Jordan's elimination, one step for all systems at once: six-by-six systems are too
    small for LAPACK to be quick at. Positive definite, so no pivoting; by columns, so that each
    operation runs along memory.
    """
    size = basis.shape[1]
    pairs = [(i, j) for i in range(size) for j in range(i, size)]
    products = np.stack([basis[:, i] * basis[:, j] for i, j in pairs], axis=-1)
    moments = product(weights, products).T.astype(np.float64, order="C")
    normal = dict(zip(pairs, moments, strict=True))
    for i in range(size):
        normal[i, i] += curvature.astype(np.float64) ** -2 if i >= 3 else 1e-6
    right = list(product(weights * samples, basis).T.astype(np.float64, order="C"))
    # From the last unknown to the second; the first one's pivot is then its inverse variance.
    for k in range(size - 1, 0, -1):
        inverse = 1.0 / normal[k, k]
        for i in range(k):
            factor = normal[i, k] * inverse
            right[i] -= factor * right[k]
            for j in range(i, k):
                normal[i, j] -= factor * normal[j, k]
    solution = np.empty((len(weights), size), np.float32)
    for i in range(size):
        known = sum(normal[k, i] * solution[:, k] for k in range(i))
        solution[:, i] = (right[i] - known) / normal[i, i]
    return solution, (1.0 / normal[0, 0]).astype(np.float32)
