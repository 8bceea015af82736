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


def scaled_by_point(ideal: Array, factor: Array, slope: Array) -> Array:
    """Derivatives (..., 2, 2), by ideal points (..., 2), of `ideal` times a factor of r^2.

    factor: its values (...) at the points.
    slope: its derivatives (...) by r^2.
    """
    x, y = ideal[..., 0], ideal[..., 1]
    derivatives = np.empty((*x.shape, 2, 2))
    derivatives[..., 0, 0] = factor + 2.0 * slope * x * x
    derivatives[..., 1, 1] = factor + 2.0 * slope * y * y
    derivatives[..., 0, 1] = derivatives[..., 1, 0] = 2.0 * slope * x * y
    return derivatives


def decentring(ideal: Array) -> Array:
    """Shifts (..., 2, 2) of points (..., 2) per unit of p1 and of p2 (OpenCV's signs)."""
    x, y = ideal[..., 0], ideal[..., 1]
    derivatives = np.empty((*x.shape, 2, 2))
    derivatives[..., 0, 0] = derivatives[..., 1, 1] = 2.0 * x * y
    derivatives[..., 0, 1] = 3.0 * x * x + y * y
    derivatives[..., 1, 0] = x * x + 3.0 * y * y
    return derivatives


def decentring_by_point(ideal: Array, p1: float, p2: float) -> Array:
    """Derivatives (..., 2, 2) of `decentring(ideal) @ (p1, p2)` by the points (..., 2)."""
    x, y = ideal[..., 0], ideal[..., 1]
    derivatives = np.empty((*x.shape, 2, 2))
    derivatives[..., 0, 0] = 2.0 * p1 * y + 6.0 * p2 * x
    derivatives[..., 0, 1] = derivatives[..., 1, 0] = 2.0 * p1 * x + 2.0 * p2 * y
    derivatives[..., 1, 1] = 6.0 * p1 * y + 2.0 * p2 * x
    return derivatives
