"""Local quadratic fits to an image of inverse depths: fast in full windows, robust in all others.

Savitzky and Golay (1964), in two dimensions. Where a window is full, the fit is a handful of fixed
convolutions; at rims, holes and jumps in depth it is a robust least-squares fit to the pixels that
belong to the same surface.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from bodyscan.arrays import Array, Bytes, Floats, Mask
from bodyscan.compiled import compiled
from bodyscan.fusion.robust_windows import fit_windows

OUTLIER_SIGMAS = 5.0
WORST_MISFIT = 4.0  # mean square residual over 5 x 5 pixels, in variances
NORMAL_MEDIAN = 0.6745  # median of the absolute value of a standard normal variable
EVERY = 8  # one row in this many is used to estimate the noise


@dataclass(frozen=True, eq=False)
class Fit:
    """Per pixel: smoothed inverse depth, its slope per column and row, its standard deviation."""

    value: Floats
    slope_u: Floats
    slope_v: Floats
    sigma: Floats


def fit_quadratics(
    inverse: Floats,
    noise: Floats,
    reach: int,
    pixel_mm: float,
    alike_px: tuple[float, float] = (0.0, 0.0),
) -> tuple[Fit, Mask]:
    """Fit an inverse depth, 0 where nothing was measured; return the fits and where they succeed.

    noise: its standard deviation; only the scale is corrected, if residuals are larger.
    reach: windows have 2 reach + 1 pixels a side, of `pixel_mm` on the surface.
    alike_px: see `noise_left`.
    """
    valid = inverse > 0
    fit, fitted = fit_whole_windows(inverse, noise, reach)
    size = _size_of_noise(inverse, noise, fit, fitted)
    noise = noise * size
    np.multiply(fit.sigma, size, out=fit.sigma)

    around = (reach, reach, reach, reach)
    padded = cv2.copyMakeBorder(inverse, *around, cv2.BORDER_CONSTANT, value=0.0)
    fits = (fit.value, fit.slope_u, fit.slope_v, fit.sigma)
    cut = np.flatnonzero(valid & ~fitted)
    fit_windows(padded, noise, cut, reach, pixel_mm, fits, fitted)
    squares, calm = np.empty_like(inverse), np.empty(inverse.shape, np.uint8)
    _square_misfits(inverse, noise, fit.value, fitted, squares, calm)
    window = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    misfit = cv2.boxFilter(squares, -1, (5, 5), borderType=cv2.BORDER_CONSTANT)
    easy = (misfit < WORST_MISFIT) & (cv2.erode(calm, window, borderValue=1) > 0)
    easy.ravel()[cut] = True  # already fitted robustly
    uneasy = np.flatnonzero(valid & ~easy)
    fit_windows(padded, noise, uneasy, reach, pixel_mm, fits, fitted)
    np.multiply(fit.sigma, np.float32(noise_left(reach, alike_px)), out=fit.sigma)
    return fit, fitted


def noise_left(reach: int, alike_px: tuple[float, float]) -> float:
    """How much more noise a window's fit keeps than if every pixel's were its own.

    alike_px: distance along rows and along columns over which the correlation of two pixels' noise
        falls linearly from one to nothing; 0 if they share none.
    """
    basis = window_basis(reach)
    weights = (np.linalg.inv(basis.T @ basis)[0] @ basis.T).reshape(2 * reach + 1, -1)
    away = np.abs(np.subtract.outer(np.arange(2 * reach + 1), np.arange(2 * reach + 1)))
    along_u, along_v = (np.maximum(0.0, 1.0 - away / max(px, 1.0)) for px in alike_px)
    kept = np.sum((along_v @ weights @ along_u) * weights)
    return float(np.sqrt(kept / np.sum(weights**2)))


def _size_of_noise(inverse: Floats, noise: Floats, fit: Fit, full: Mask) -> np.float32:
    """Factor for `noise`, at least 1, from the residuals of full windows."""
    there = full[::EVERY]
    if not there.any():
        return np.float32(1.0)
    residual = (inverse - fit.value)[::EVERY][there] / noise[::EVERY][there]
    # A residual lacks the part of its own noise that the fit absorbed.
    own_share = np.square(fit.sigma[::EVERY][there][0] / noise[::EVERY][there][0])
    typical = np.median(np.abs(residual)) / np.sqrt(1.0 - own_share)
    return np.float32(max(1.0, typical / NORMAL_MEDIAN))


@compiled
def _square_misfits(
    inverse: Floats,
    noise: Floats,
    value: Floats,
    fitted: Mask,
    squares: Floats,
    calm: Bytes,
) -> None:
    """Set squared residuals over variances, 0 where nothing was measured, and `calm`.

    calm: 0 at outliers and at pixels without a fit, else 1.
    """
    for row in range(inverse.shape[0]):
        for column in range(inverse.shape[1]):
            squares[row, column] = 0.0
            calm[row, column] = 1
            if inverse[row, column] > 0:
                off = (inverse[row, column] - value[row, column]) / noise[row, column]
                squares[row, column] = off * off
                small = abs(off) < OUTLIER_SIGMAS
                calm[row, column] = small and fitted[row, column]


def fit_whole_windows(inverse: Floats, noise: Floats, reach: int) -> tuple[Fit, Mask]:
    """The fit without a look at edges, and the pixels around which there are none: all of the window
    is measured, but for small holes."""
    valid = inverse > 0
    closed, whole = close_holes(inverse, valid)
    window = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    inside = cv2.erode(whole.astype(np.uint8), window, borderValue=0) > 0
    return fit_full_windows(closed, noise, reach), valid & inside


def close_holes(inverse: Floats, valid: Mask) -> tuple[Floats, Mask]:
    """Fill holes of a few pixels, so that they do not spoil the windows around them.

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


def fit_full_windows(inverse: Floats, noise: Floats, reach: int) -> Fit:
    """The quadratic fit of full windows, as separable convolutions."""
    offsets = np.arange(-reach, reach + 1, dtype=float)
    basis = window_basis(reach)
    normal = np.linalg.inv(basis.T @ basis)
    one, slope, square = np.ones_like(offsets), offsets, offsets**2

    def convolve(rows: Array, columns: Array) -> Floats:
        return cv2.sepFilter2D(inverse, cv2.CV_32F, columns, rows, borderType=cv2.BORDER_CONSTANT)

    constant, along_u2, along_v2 = normal[0, 0], normal[0, 3], normal[0, 5]
    value = convolve(one, constant * one + along_u2 * square) + convolve(along_v2 * square, one)
    slope_u = convolve(one, normal[1, 1] * slope)
    slope_v = convolve(normal[2, 2] * slope, one)
    return Fit(value, slope_u, slope_v, noise * np.float32(np.sqrt(constant)))


def window_basis(reach: int) -> Array:
    """(samples, 6): 1, du, dv, du^2, du dv, dv^2 over a square window, row by row."""
    dv, du = np.mgrid[-reach : reach + 1, -reach : reach + 1].reshape(2, -1).astype(float)
    return np.stack([np.ones_like(du), du, dv, du * du, du * dv, dv * dv], axis=-1)
