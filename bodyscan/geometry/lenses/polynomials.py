"""Building blocks of OpenCV's lenses: a factor that changes with the radius, and decentring."""

from __future__ import annotations

import numpy as np

from bodyscan.arrays import Array

DECENTRED = 5e-4
"""Standard deviation of p1 and p2 before any image: real lenses have 1e-4 to 1e-3. A few boards
hardly separate p1 and p2 from the principal point; with a prior ten times as wide Brown's lens did
worse on held-out boards than k1 and k2 alone."""


def squared_radius(ideal: Array) -> Array:
    """r^2 (...) of points (..., 2); numpy's sum over so short an axis takes ten times as long."""
    x, y = ideal[..., 0], ideal[..., 1]
    return np.asarray(x * x + y * y, np.float64)


def split_coordinates(points: Array) -> Array:
    """A copy of points (..., 2) whose x lie side by side in memory, and so do their y: arithmetic on
    one coordinate is then several times faster."""
    return np.moveaxis(np.array([points[..., 0], points[..., 1]], np.float64), 0, -1)


def _matrices(shape: tuple[int, ...]) -> Array:
    """Space for matrices (*shape, 2, 2), each of their entries side by side in memory."""
    return np.moveaxis(np.empty((2, 2, *shape)), (0, 1), (-2, -1))


def radial_jacobian(ideal: Array, factor: Array, slope: Array) -> Array:
    """Derivatives (..., 2, 2), by ideal points (..., 2), of `ideal` times a factor of r^2.

    factor: its values (...) at the points.
    slope: its derivatives (...) by r^2.
    """
    x, y = ideal[..., 0], ideal[..., 1]
    derivatives = _matrices(x.shape)
    along_x, along_y = 2.0 * slope * x, 2.0 * slope * y
    derivatives[..., 0, 0] = factor + along_x * x
    derivatives[..., 1, 1] = factor + along_y * y
    derivatives[..., 0, 1] = derivatives[..., 1, 0] = along_x * y
    return derivatives


def decentring(ideal: Array) -> Array:
    """Shifts (..., 2, 2) of points (..., 2) per unit of p1 and of p2 (OpenCV's signs)."""
    x, y = ideal[..., 0], ideal[..., 1]
    derivatives = _matrices(x.shape)
    derivatives[..., 0, 0] = derivatives[..., 1, 1] = 2.0 * x * y
    derivatives[..., 0, 1] = 3.0 * x * x + y * y
    derivatives[..., 1, 0] = x * x + 3.0 * y * y
    return derivatives


def displace_by_decentring(ideal: Array, p1: float, p2: float) -> Array:
    """(..., 2): where p1 and p2 move the points (..., 2), `decentring(ideal) @ (p1, p2)`."""
    x, y = ideal[..., 0], ideal[..., 1]
    xx, xy, yy = x * x, 2.0 * x * y, y * y
    moved = np.empty_like(ideal, np.float64)
    moved[..., 0] = p1 * xy + p2 * (3.0 * xx + yy)
    moved[..., 1] = p1 * (xx + 3.0 * yy) + p2 * xy
    return moved


def decentring_jacobian(ideal: Array, p1: float, p2: float) -> Array:
    """Derivatives (..., 2, 2) of `decentring(ideal) @ (p1, p2)` by the points (..., 2)."""
    x, y = ideal[..., 0], ideal[..., 1]
    derivatives = _matrices(x.shape)
    derivatives[..., 0, 0] = 2.0 * p1 * y + 6.0 * p2 * x
    derivatives[..., 0, 1] = derivatives[..., 1, 0] = 2.0 * p1 * x + 2.0 * p2 * y
    derivatives[..., 1, 1] = 6.0 * p1 * y + 2.0 * p2 * x
    return derivatives
