"""Fit spheres to points, and judge them by the chapter's Eq. 19.

E is a mean square, in mm^2, though the chapter calls it a distance. It is nearly blind to how a
pair was calibrated (a slightly wrong scale or bend moves a sphere far more than it dents it), so
the distances between the spheres' centres are judged too.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.distance import pdist

from bodyscan.arrays import Array
from bodyscan.errors import FailedWork
from bodyscan.geometry.least_squares import Block, Noise, minimize
from bodyscan.geometry.robust import rms


@dataclass(frozen=True, eq=False)
class Sphere:
    """centre: (3,) and radius, mm, in the frame of the points it was fitted to."""

    centre: Array
    radius: float

    def distances(self, points: Array) -> Array:
        """Distances (N,) mm of points (N, 3) from the surface, positive outside."""
        return np.linalg.norm(points - self.centre, axis=-1) - self.radius


@dataclass(frozen=True, eq=False)
class SphereAccuracy:
    """One measured sphere of known radius.

    points: number of points.
    given: the fit with its radius held.
    fitted: the fit with its radius free.
    e_given, e_fitted: Eq. 19 for each, mm^2.
    """

    points: int
    given: Sphere
    fitted: Sphere
    e_given: float
    e_fitted: float


def mean_square(points: Array, sphere: Sphere) -> float:
    """Eq. 19, E in mm^2, over all points (N, 3): none is left out."""
    return float(np.mean(sphere.distances(points) ** 2))


FEWEST_POINTS = 50
SETTLED = 1e-8  # a ten-thousandth of the centre's sigma
SURFACE = Noise("distance from the surface", cauchy=4.0)


def fit_sphere(points: Array, radius: float | None = None) -> Sphere:
    """Fit a sphere to points (N, 3): least distances from the surface, Cauchy loss.

    radius: held if given.

    Raises FailedWork for fewer than 50 points.
    """
    if len(points) < FEWEST_POINTS:
        raise FailedWork(f"{len(points)} points are too few for a sphere")
    sphere = _fit_algebraically(points)
    if radius is not None:
        sphere = Sphere(sphere.centre, radius)
    free = 4 if radius is None else 3

    def blocks(sphere: Sphere) -> list[Block]:
        def jacobian() -> Array:
            arm = sphere.centre - points
            arm /= np.linalg.norm(arm, axis=1, keepdims=True)
            return np.column_stack([arm, -np.ones(len(points))])[:, :free]

        return [Block(sphere.distances(points), jacobian, slice(0, free), SURFACE)]

    def moved(sphere: Sphere, step: Array) -> Sphere:
        return Sphere(sphere.centre + step[:3], sphere.radius + float(np.sum(step[3:])))

    return minimize(sphere, blocks, moved, unknowns=free, tolerance=SETTLED).state


def measure_sphere(points: Array, radius: float) -> SphereAccuracy:
    """Measure a sphere of known radius from all points (N, 3) on it."""
    given, fitted = fit_sphere(points, radius), fit_sphere(points)
    return SphereAccuracy(
        len(points), given, fitted, mean_square(points, given), mean_square(points, fitted)
    )


@dataclass(frozen=True)
class CentreDistances:
    """Distances between sphere centres against the truth.

    rms_mm: RMS of their errors.
    scale_ppm: measured over true, less 1, in ppm.
    """

    rms_mm: float
    scale_ppm: float


def centre_distances(measured: Array, true: Array) -> CentreDistances:
    """Compare centres (N, 3) as measured and as they are, each in any frame."""
    found, wanted = pdist(measured), pdist(true)
    scale = float(found @ wanted / (wanted @ wanted)) - 1.0
    return CentreDistances(rms(found - wanted), 1e6 * scale)


def _fit_algebraically(points: Array) -> Sphere:
    """|p|^2 = 2 c . p + (r^2 - c^2), linear in c and the last term; about the points' middle."""
    middle = points.mean(axis=0)
    centred = points - middle
    rows = np.column_stack([2.0 * centred, np.ones(len(points))])
    solved = np.linalg.lstsq(rows, np.sum(centred**2, axis=1), rcond=None)[0]
    centre = solved[:3]
    return Sphere(centre + middle, float(np.sqrt(max(solved[3] + centre @ centre, 1e-12))))
