"""A flat plane in a range image: how far it is from flat, and how much of that is not noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre

from bodyscan.arrays import Array
from bodyscan.geometry.robust import rms

DEGREE = 6


@dataclass(frozen=True, eq=False)
class Flatness:
    """Flatness of points measured on a plane.

    points: number of points.
    normal, offset_mm: the best plane, normal . p = offset; normal: (3,).
    rms_mm: RMS of the points' distances from it.
    systematic_rms_mm: RMS of the smooth part of the distances.
    """

    points: int
    normal: Array
    offset_mm: float
    rms_mm: float
    systematic_rms_mm: float


def best_plane(points: Array) -> tuple[Array, float]:
    """Unit normal (3,) and offset of the plane through points (N, 3), by least squares."""
    middle = points.mean(axis=0)
    centred = points - middle
    _, vectors = np.linalg.eigh(centred.T @ centred)
    normal = vectors[:, 0] * (np.sign(vectors[:, 0] @ middle) or 1.0)
    return normal, float(normal @ middle)


def flatness(points: Array, degree: int = DEGREE) -> Flatness:
    """Flatness of points (N, 3) measured on a flat plane.

    The smooth part of the distances is a polynomial of this degree over the plane (products of
    Legendre polynomials); noise of N points contributes only sqrt(terms / N) of itself to it.
    """
    normal, offset = best_plane(points)
    distances = points @ normal - offset
    smooth = smooth_part(points, distances, degree)
    return Flatness(len(points), normal, offset, rms(distances), rms(smooth))


def smooth_part(points: Array, values: Array, degree: int = DEGREE) -> Array:
    """The polynomial over a plane nearest to values (N,) at points (N, 3), (N,)."""
    middle = points.mean(axis=0)
    centred = points - middle
    _, vectors = np.linalg.eigh(centred.T @ centred)
    place = centred @ vectors[:, 1:]
    place /= np.abs(place).max(axis=0)
    rows = legendre.legvander2d(place[:, 0], place[:, 1], [degree, degree])
    total = np.add.outer(np.arange(degree + 1), np.arange(degree + 1)).ravel()
    rows = rows[:, total <= degree]
    # Products of Legendre polynomials are nearly orthogonal: normal equations lose no accuracy.
    return np.asarray(rows @ np.linalg.lstsq(rows.T @ rows, rows.T @ values)[0], np.float64)
