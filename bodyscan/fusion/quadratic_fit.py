"""Local quadratic fits to an image of inverse depths.

A full window takes a few fixed convolutions (Savitzky and Golay 1964, in two dimensions). At rims,
holes and jumps in depth each window is fitted by trimmed least squares to the pixels that belong to
the centre's surface.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from bodyscan.arrays import Array, Floats, Mask
from bodyscan.compiled import compiled
from bodyscan.geometry.robust import SIGMAS_PER_MEDIAN


@dataclass(frozen=True, eq=False)
class QuadraticFit:
    """Per pixel (h, w): fitted inverse depth, its slope per column and row, its sigma."""

    value: Floats
    slope_u: Floats
    slope_v: Floats
    sigma: Floats


def fit_quadratics(
    inverse: Floats,
    noise: Floats,
    reach: int,
    pixel_mm: float,
    correlation_px: tuple[float, float] = (0.0, 0.0),
) -> tuple[QuadraticFit, Mask]:
    """Fit a quadratic around every measured pixel; return the fits and where they succeed, (h, w).

    inverse, noise: inverse depths (h, w), 0 where nothing was measured, and their standard
        deviation, which is scaled up if the residuals are larger.
    reach: windows have 2 reach + 1 pixels a side, of `pixel_mm` on the surface.
    correlation_px: see `compute_noise_gain`.
    """
    valid = inverse > 0
    fit, fitted = fit_full_windows(inverse, noise, reach)
    scale = _estimate_noise_scale(inverse, noise, fit, fitted)
    noise = noise * scale
    np.multiply(fit.sigma, scale, out=fit.sigma)

    cut = np.flatnonzero(valid & ~fitted)
    fit_trimmed_windows(inverse, noise, cut, reach, pixel_mm, fit, fitted)
    with np.errstate(divide="ignore", invalid="ignore"):
        residual = np.where(valid, (inverse - fit.value) / noise, np.float32(0.0))
    inlier = ~valid | ((np.abs(residual) < 5.0) & fitted)
    window = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    mean_square = cv2.boxFilter(residual * residual, -1, (5, 5), borderType=cv2.BORDER_CONSTANT)
    # A mean square of 4 variances over 5 x 5 pixels is a jump in depth, not noise.
    smooth = (mean_square < 4.0) & (cv2.erode(inlier.view(np.uint8), window, borderValue=1) > 0)
    smooth.ravel()[cut] = True  # already fitted by trimmed least squares
    jumps = np.flatnonzero(valid & ~smooth)
    fit_trimmed_windows(inverse, noise, jumps, reach, pixel_mm, fit, fitted)
    np.multiply(fit.sigma, np.float32(compute_noise_gain(reach, correlation_px)), out=fit.sigma)
    return fit, fitted


def compute_noise_gain(reach: int, correlation_px: tuple[float, float]) -> float:
    """Sigma of a full window's fit to correlated noise, over that to white noise.

    correlation_px: distance along rows and along columns over which the correlation of two pixels'
        noise falls linearly from 1 to 0; 0 for white noise.
    """
    basis = make_window_basis(reach)
    weights = (np.linalg.inv(basis.T @ basis)[0] @ basis.T).reshape(2 * reach + 1, -1)
    distance = np.abs(np.subtract.outer(np.arange(2 * reach + 1), np.arange(2 * reach + 1)))
    along_u, along_v = (np.maximum(0.0, 1.0 - distance / max(px, 1.0)) for px in correlation_px)
    variance = np.sum((along_v @ weights @ along_u) * weights)
    return float(np.sqrt(variance / np.sum(weights**2)))


def fit_full_windows(inverse: Floats, noise: Floats, reach: int) -> tuple[QuadraticFit, Mask]:
    """Fit all windows by convolution, and find the measured pixels (h, w) whose window is full,
    holes of a few pixels closed; other fits are worthless."""
    valid = inverse > 0
    closed, known = close_holes(inverse, valid)
    window = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    full = cv2.erode(known.astype(np.uint8), window, borderValue=0) > 0
    return convolve_quadratics(closed, noise, reach), valid & full


def convolve_quadratics(inverse: Floats, noise: Floats, reach: int) -> QuadraticFit:
    """Least-squares quadratics of full windows, as separable convolutions."""
    offsets = np.arange(-reach, reach + 1, dtype=float)
    basis = make_window_basis(reach)
    normal = np.linalg.inv(basis.T @ basis)
    one, slope, square = np.ones_like(offsets), offsets, offsets**2

    def convolve(rows: Array, columns: Array) -> Floats:
        return cv2.sepFilter2D(inverse, cv2.CV_32F, columns, rows, borderType=cv2.BORDER_CONSTANT)

    constant, along_u2, along_v2 = normal[0, 0], normal[0, 3], normal[0, 5]
    value = convolve(one, constant * one + along_u2 * square) + convolve(along_v2 * square, one)
    slope_u = convolve(one, normal[1, 1] * slope)
    slope_v = convolve(normal[2, 2] * slope, one)
    return QuadraticFit(value, slope_u, slope_v, noise * np.float32(np.sqrt(constant)))


def close_holes(inverse: Floats, valid: Mask) -> tuple[Floats, Mask]:
    """Fill holes of a few pixels by the mean of opposite neighbours up to two pixels away, exact
    on a plane; four of the twelve pairs must be there. Returns the image and where it has
    values."""
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


def make_window_basis(reach: int) -> Array:
    """(samples, 6): 1, du, dv, du^2, du dv, dv^2 over a square window, row by row."""
    dv, du = np.mgrid[-reach : reach + 1, -reach : reach + 1].reshape(2, -1).astype(float)
    return np.stack([np.ones_like(du), du, dv, du * du, du * dv, dv * dv], axis=-1)


def fit_trimmed_windows(
    inverse: Floats,
    noise: Floats,
    pixels: NDArray[np.intp],
    reach: int,
    pixel_mm: float,
    fit: QuadraticFit,
    fitted: Mask,
) -> None:
    """Fit the windows around measured pixels (flat indices) to samples on the centre's surface.

    Writes `fit` there, and `fitted`: whether the pixel lies on its own fit and enough samples do.
    Trimmed least squares, from the closest neighbours outwards, with a prior on the second
    derivatives: surfaces rarely curve more tightly than a radius of 6 mm.
    """
    border = (reach, reach, reach, reach)
    padded = cv2.copyMakeBorder(inverse, *border, cv2.BORDER_CONSTANT, value=0.0)
    fits = (fit.value, fit.slope_u, fit.slope_v, fit.sigma)
    _fit_trimmed(make_window_basis(reach), padded, noise, pixels, reach, pixel_mm, fits, fitted)


@compiled
def _fit_trimmed(
    basis: Array,
    padded: Floats,
    noise: Floats,
    pixels: NDArray[np.intp],
    reach: int,
    pixel_mm: float,
    fits: tuple[Floats, Floats, Floats, Floats],
    fitted: Mask,
) -> None:
    width = noise.shape[1]
    residual, inlier = np.empty(len(basis)), np.empty(len(basis), np.bool_)
    normal, solution = np.empty((6, 6)), np.empty(6)
    for pixel in pixels:
        row, column = pixel // width, pixel % width
        centre, unit = float(padded[row + reach, column + reach]), float(noise[row, column])
        # Change of 1/z, in sigmas, per pixel on a surface at 45 degrees.
        step = pixel_mm * centre * centre / unit
        for n in range(len(basis)):
            du, dv = int(basis[n, 1]), int(basis[n, 2])
            sample, distance = padded[row + reach + dv, column + reach + du], np.hypot(du, dv)
            residual[n] = (float(sample) - centre) / unit
            # Four sigmas, plus as much as the steepest useful surface rises.
            near = sample > 0.0 and abs(residual[n]) < 4.0 + 4.0 * step * distance
            if not near:
                residual[n] = np.inf
            inlier[n] = near and distance < 2.5
        ridge = (step * pixel_mm / (2.0 * 6.0)) ** -2.0
        for limit in (8.0, 3.0):
            _solve_window(basis, residual, inlier, ridge, normal, solution)
            for n in range(len(basis)):
                model = 0.0
                for i in range(6):
                    model += basis[n, i] * solution[i]
                inlier[n] = abs(residual[n] - model) < limit
        count = _solve_window(basis, residual, inlier, ridge, normal, solution)
        variance = 1.0 / normal[0, 0]
        fits[0][row, column] = centre + solution[0] * unit
        fits[1][row, column] = solution[1] * unit
        fits[2][row, column] = solution[2] * unit
        fits[3][row, column] = np.sqrt(variance) * unit
        fitted[row, column] = abs(solution[0]) < 4.0 and variance < 1.0 and count >= 15


@compiled
def _solve_window(
    basis: Array, residual: Array, inlier: Mask, ridge: float, normal: Array, solution: Array
) -> int:
    """Solve for a window's six coefficients; return the number of inliers.

    basis: (samples, 6), see `make_window_basis`. ridge: information of the prior on each of the last
        three.
    normal: overwritten; its first element becomes the first coefficient's inverse variance.
    """
    count = 0
    for i in range(6):
        solution[i] = 0.0
        for j in range(i, 6):
            normal[i, j] = 0.0
        normal[i, i] = ridge if i > 2 else 1e-6
    for n in range(len(basis)):
        if inlier[n]:
            count += 1
            for i in range(6):
                solution[i] += basis[n, i] * residual[n]
                for j in range(i, 6):
                    normal[i, j] += basis[n, i] * basis[n, j]
    # Gaussian elimination from the last unknown to the second: the first one's pivot is then its
    # inverse variance. The matrix is positive definite, so no pivoting is needed.
    for k in range(5, 0, -1):
        for i in range(k):
            factor = normal[i, k] / normal[k, k]
            solution[i] -= factor * solution[k]
            for j in range(i, k):
                normal[i, j] -= factor * normal[j, k]
    for i in range(6):
        for k in range(i):
            solution[i] -= normal[k, i] * solution[k]
        solution[i] /= normal[i, i]
    return count


def _estimate_noise_scale(
    inverse: Floats, noise: Floats, fit: QuadraticFit, full: Mask
) -> np.float32:
    """Factor for `noise`, at least 1, from the residuals of full windows in every 8th row."""
    there = full[::8]
    if not there.any():
        return np.float32(1.0)
    residual = (inverse - fit.value)[::8][there] / noise[::8][there]
    # A residual lacks the part of the pixel's noise that the fit absorbed.
    absorbed = np.square(fit.sigma[::8][there][0] / noise[::8][there][0])
    typical = np.median(np.abs(residual)) / np.sqrt(1.0 - absorbed)
    return np.float32(max(1.0, SIGMAS_PER_MEDIAN * typical))
