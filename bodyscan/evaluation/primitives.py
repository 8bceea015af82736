"""Fit spheres and planes to points, and find spheres in a range image.

E of Eq. 19 is a mean square, in mm^2, though the chapter calls it a distance. It is nearly blind to
how a pair was calibrated (a slightly wrong scale moves a sphere far more than it dents it), so the
distances between the spheres' centres are compared too.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre
from scipy.spatial.distance import pdist

from bodyscan.arrays import Array
from bodyscan.errors import FailedWork
from bodyscan.geometry.least_squares import Block, Noise, minimize
from bodyscan.geometry.robust import estimate_robust_scale, rms


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
    """One sphere of known radius: the fits with radius held and free, and Eq. 19 of each, mm^2."""

    points: int
    given: Sphere
    fitted: Sphere
    e_given: float
    e_fitted: float


def compute_mean_square_distance(points: Array, sphere: Sphere) -> float:
    """Eq. 19, E in mm^2, over all points (N, 3): none is left out."""
    return float(np.mean(sphere.distances(points) ** 2))


MIN_POINTS = 50
SURFACE = Noise("distance from the surface", cauchy=4.0)


def fit_sphere(points: Array, radius: float | None = None) -> Sphere:
    """Fit a sphere to points (N, 3) by their distances, Cauchy loss; radius: held if given.

    Raises FailedWork for fewer than 50 points.
    """
    if len(points) < MIN_POINTS:
        raise FailedWork(f"{len(points)} points are too few for a sphere")
    # Start: |p|^2 = 2 c . p + (r^2 - c^2), linear in c and the last term; about the points' middle.
    middle = points.mean(axis=0)
    centred = points - middle
    rows = np.column_stack([2.0 * centred, np.ones(len(points))])
    *centre, rest = np.linalg.lstsq(rows, np.sum(centred**2, axis=1), rcond=None)[0]
    found = float(np.sqrt(max(rest + np.dot(centre, centre), 1e-12)))
    sphere = Sphere(centre + middle, found if radius is None else radius)
    free = 4 if radius is None else 3

    def blocks(sphere: Sphere) -> list[Block]:
        def jacobian() -> Array:
            arm = sphere.centre - points
            arm /= np.linalg.norm(arm, axis=1, keepdims=True)
            return np.column_stack([arm, -np.ones(len(points))])[:, :free]

        return [Block(sphere.distances(points), jacobian, slice(0, free), SURFACE)]

    def retract(sphere: Sphere, step: Array) -> Sphere:
        return Sphere(sphere.centre + step[:3], sphere.radius + float(np.sum(step[3:])))

    return minimize(sphere, blocks, retract, unknowns=free, tolerance=1e-8).state


def measure_sphere(points: Array, radius: float) -> SphereAccuracy:
    """Measure a sphere of known radius from all points (N, 3) on it."""
    spheres = fit_sphere(points, radius), fit_sphere(points)
    errors = [compute_mean_square_distance(points, sphere) for sphere in spheres]
    return SphereAccuracy(len(points), *spheres, *errors)


@dataclass(frozen=True)
class CentreDistances:
    """Distances between sphere centres against the truth."""

    rms_mm: float  # RMS of their errors
    scale_ppm: float  # measured over true, less 1, in ppm


def compare_centre_distances(measured: Array, true: Array) -> CentreDistances:
    """Compare centres (N, 3) as measured and as they are, each in any frame."""
    found, wanted = pdist(measured), pdist(true)
    scale = float(found @ wanted / (wanted @ wanted)) - 1.0
    return CentreDistances(rms(found - wanted), 1e6 * scale)


@dataclass(frozen=True, eq=False)
class Flatness:
    """RMS of the distances of points from the best plane, and of their smooth part."""

    rms_mm: float
    systematic_rms_mm: float


def fit_plane(points: Array) -> tuple[Array, float]:
    """Fit a plane to points (N, 3) by total least squares; return unit normal (3,) and offset."""
    middle, axes = _compute_principal_axes(points)
    normal = axes[:, 0] * (np.sign(axes[:, 0] @ middle) or 1.0)
    return normal, float(normal @ middle)


def _compute_principal_axes(points: Array) -> tuple[Array, Array]:
    """Mean (3,) of points (N, 3), and unit vectors (3, 3), columns, of growing spread about it."""
    middle = points.mean(axis=0)
    centred = points - middle
    return middle, np.linalg.eigh(centred.T @ centred)[1]


def measure_flatness(points: Array) -> Flatness:
    """Measure the flatness of points (N, 3) on a plane.

    The smooth part of the distances is a polynomial of degree 6 over the plane (products of
    Legendre polynomials); noise of N points contributes only sqrt(terms / N) of itself to it.
    """
    normal, offset = fit_plane(points)
    distances = points @ normal - offset
    smooth = fit_polynomial(points, distances)
    return Flatness(rms(distances), rms(smooth))


def fit_polynomial(points: Array, values: Array, degree: int = 6) -> Array:
    """Fit a polynomial over a plane to values (N,) at points (N, 3); return it there, (N,)."""
    middle, axes = _compute_principal_axes(points)
    position = (points - middle) @ axes[:, 1:]
    position /= np.abs(position).max(axis=0)
    rows = legendre.legvander2d(position[:, 0], position[:, 1], [degree, degree])
    total = np.add.outer(np.arange(degree + 1), np.arange(degree + 1)).ravel()
    rows = rows[:, total <= degree]
    # Products of Legendre polynomials are nearly orthogonal: normal equations lose no accuracy.
    return np.asarray(rows @ np.linalg.lstsq(rows.T @ rows, rows.T @ values)[0], np.float64)


VOTE_CELL = 0.2
"""radii: size of a cell in which votes for a centre are counted."""


def find_spheres(points: Array, normals: Array, radius: float, count: int) -> list[Sphere]:
    """The `count` spheres of one radius in a range image, numbered from top left to bottom right.

    points, normals: (H, W, 3), normals towards the camera, NaN where nothing was measured.

    Points vote for the place one radius behind them (Hough). Raises FailedWork if fewer are found.
    """
    flat, votes = points.reshape(-1, 3), (points - radius * normals).reshape(-1, 3)
    known = np.isfinite(votes).all(axis=1)
    flat, votes = flat[known].astype(float), votes[known].astype(float)
    found: list[Sphere] = []
    for _ in range(count):
        sphere = _find_sphere(flat, votes, radius)
        if sphere is None:
            what = f"{len(found)} spheres of radius {radius:g} mm found, {count} were expected"
            raise FailedWork(what, remedy="see that all spheres are in view and lit")
        found.append(sphere)
        rest = np.linalg.norm(flat - sphere.centre, axis=1) > 1.15 * radius
        flat, votes = flat[rest], votes[rest]
    return _sort_in_reading_order(found)


def _find_sphere(points: Array, votes: Array, radius: float) -> Sphere | None:
    cells = np.floor(votes / (VOTE_CELL * radius)).astype(np.int64)
    if len(cells) < MIN_POINTS:
        return None
    _, cell, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    centre = np.median(votes[cell.ravel() == np.argmax(count)], axis=0)
    for _ in range(3):
        near = np.linalg.norm(votes - centre, axis=1) < 2.0 * VOTE_CELL * radius
        if near.sum() < MIN_POINTS:
            return None
        centre = np.median(votes[near], axis=0)
    distance = np.abs(np.linalg.norm(points - centre, axis=1) - radius)
    inliers = points[distance < 0.15 * radius]
    if len(inliers) < MIN_POINTS:
        return None
    sphere = fit_sphere(inliers, radius)
    normal, offset = fit_plane(inliers)
    flat = estimate_robust_scale(inliers @ normal - offset)
    # Ground between the spheres gathers votes too, but a plane fits it better.
    return sphere if estimate_robust_scale(sphere.distances(inliers)) < 0.5 * flat else None


def _sort_in_reading_order(spheres: list[Sphere]) -> list[Sphere]:
    """Rows from the top of the image down, each from left to right. A row ends where the next sphere is
    more than a radius lower."""
    by_height = sorted(spheres, key=lambda sphere: float(sphere.centre[1]))
    rows: list[list[Sphere]] = []
    for sphere in by_height:
        if rows and sphere.centre[1] - rows[-1][-1].centre[1] < sphere.radius:
            rows[-1].append(sphere)
        else:
            rows.append([sphere])
    return [one for row in rows for one in sorted(row, key=lambda one: float(one.centre[0]))]
