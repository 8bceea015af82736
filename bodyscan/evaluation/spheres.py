"""Spheres in a range image: found, fitted, and judged by the chapter's Eq. 19.

E is a mean square, in mm^2: the chapter calls it a distance. It is nearly blind to how a pair was
calibrated (a slightly wrong scale or bend moves a sphere far more than it dents it), so the
distances between the spheres' centres are judged too.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodyscan.arrays import Array
from bodyscan.errors import FailedWork
from bodyscan.evaluation.planes import best_plane
from bodyscan.geometry.least_squares import spread

FEWEST_POINTS = 50
ROUNDS = 30
SETTLED_MM = 1e-7
CAUCHY_SIGMAS = 4.0
VOTE_CELL = 0.2
"""Size of a cell in which votes for a centre are counted, in radii."""
REACH = 1.15
"""Points within so many radii of a centre may be the sphere's own when it is found."""
OFF_SURFACE = 0.15
"""How far off its surface they may lie, in radii."""
ROUNDER = 0.5
"""By how much a sphere must explain its points better than a plane does."""


@dataclass(frozen=True, eq=False)
class Sphere:
    """centre (3,) and radius, mm, in the frame of the points it was fitted to."""

    centre: Array
    radius: float

    def distances(self, points: Array) -> Array:
        """(N,) mm of points (N, 3) from the surface, positive outside."""
        return np.linalg.norm(points - self.centre, axis=-1) - self.radius


@dataclass(frozen=True, eq=False)
class SphereAccuracy:
    """One sphere of known radius, as it was measured.

    points: how many.  given: fitted with its radius held.  fitted: with its radius free.
    e_given, e_fitted: Eq. 19 for either, mm^2.
    """

    points: int
    given: Sphere
    fitted: Sphere
    e_given: float
    e_fitted: float


def mean_square(points: Array, sphere: Sphere) -> float:
    """Eq. 19, E in mm^2, over all of the points (N, 3): none is left out."""
    return float(np.mean(sphere.distances(points) ** 2))


def fit_sphere(points: Array, radius: float | None = None) -> Sphere:
    """Through points (N, 3): least distances from the surface, Cauchy loss.

    radius: held if given.  Raises FailedWork for fewer than 50 points.
    """
    if len(points) < FEWEST_POINTS:
        raise FailedWork(f"{len(points)} points are too few for a sphere")
    sphere = _algebraic(points)
    if radius is not None:
        sphere = Sphere(sphere.centre, radius)
    for _ in range(ROUNDS):
        arm = points - sphere.centre
        length = np.linalg.norm(arm, axis=1)
        distance = length - sphere.radius
        weights = 1.0 / (1.0 + (distance / (CAUCHY_SIGMAS * spread(distance))) ** 2)
        jacobian = -arm / length[:, None]
        if radius is None:
            jacobian = np.column_stack([jacobian, -np.ones(len(points))])
        weighted = jacobian * weights[:, None]
        step = -np.linalg.solve(weighted.T @ jacobian, weighted.T @ distance)
        more = float(step[3]) if radius is None else 0.0
        sphere = Sphere(sphere.centre + step[:3], sphere.radius + more)
        if np.linalg.norm(step) < SETTLED_MM:
            break
    return sphere


def measure_sphere(points: Array, radius: float) -> SphereAccuracy:
    """A sphere of known radius from all points (N, 3) measured on it."""
    given, fitted = fit_sphere(points, radius), fit_sphere(points)
    return SphereAccuracy(
        len(points), given, fitted, mean_square(points, given), mean_square(points, fitted)
    )


def find_spheres(points: Array, normals: Array, radius: float, count: int) -> list[Sphere]:
    """The `count` spheres of one radius in a range image, numbered from top left to bottom right.

    points, normals: (H, W, 3), normals towards the camera, NaN where nothing was measured. Every
    point votes for the place one radius behind it; where votes gather is a centre.  Raises
    FailedWork if fewer are found.
    """
    flat, votes = points.reshape(-1, 3), (points - radius * normals).reshape(-1, 3)
    known = np.isfinite(votes).all(axis=1)
    flat, votes = flat[known].astype(float), votes[known].astype(float)
    found: list[Sphere] = []
    for _ in range(count):
        sphere = _most_voted(flat, votes, radius)
        if sphere is None:
            raise FailedWork(
                f"{len(found)} spheres of radius {radius:g} mm found, {count} were expected",
                remedy="see that all spheres are in the picture and lit",
            )
        found.append(sphere)
        left = np.linalg.norm(flat - sphere.centre, axis=1) > REACH * radius
        flat, votes = flat[left], votes[left]
    return _in_reading_order(found)


@dataclass(frozen=True)
class CentreDistances:
    """Distances between sphere centres against the truth: RMS of their errors (mm), and the scale:
    measured over true, less 1, in ppm."""

    rms_mm: float
    scale_ppm: float


def centre_distances(measured: Array, true: Array) -> CentreDistances:
    """From centres (N, 3) as measured and as they are, in any two frames."""
    first, second = np.triu_indices(len(true), 1)
    found = np.linalg.norm(measured[first] - measured[second], axis=1)
    wanted = np.linalg.norm(true[first] - true[second], axis=1)
    scale = float(found @ wanted / (wanted @ wanted)) - 1.0
    return CentreDistances(float(np.sqrt(np.mean((found - wanted) ** 2))), 1e6 * scale)


def _algebraic(points: Array) -> Sphere:
    """|p|^2 = 2 c . p + (r^2 - c^2), linear in c and the last term; about the points' middle."""
    middle = points.mean(axis=0)
    centred = points - middle
    rows = np.column_stack([2.0 * centred, np.ones(len(points))])
    solved = np.linalg.lstsq(rows, np.sum(centred**2, axis=1), rcond=None)[0]
    centre = solved[:3]
    return Sphere(centre + middle, float(np.sqrt(max(solved[3] + centre @ centre, 1e-12))))


def _most_voted(points: Array, votes: Array, radius: float) -> Sphere | None:
    cells = np.floor(votes / (VOTE_CELL * radius)).astype(np.int64)
    if len(cells) < FEWEST_POINTS:
        return None
    _, cell, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    centre = np.median(votes[cell.ravel() == np.argmax(count)], axis=0)
    for _ in range(3):
        near = np.linalg.norm(votes - centre, axis=1) < 2.0 * VOTE_CELL * radius
        if near.sum() < FEWEST_POINTS:
            return None
        centre = np.median(votes[near], axis=0)
    own = points[np.abs(np.linalg.norm(points - centre, axis=1) - radius) < OFF_SURFACE * radius]
    if len(own) < FEWEST_POINTS:
        return None
    sphere = fit_sphere(own, radius)
    normal, offset = best_plane(own)
    flat = spread(own @ normal - offset)
    # Ground between the spheres gathers votes too, but a plane explains it better.
    return sphere if spread(sphere.distances(own)) < ROUNDER * flat else None


def _in_reading_order(spheres: list[Sphere]) -> list[Sphere]:
    """Rows from the top of the image down, each from left to right: a row ends where the next
    sphere is more than a radius lower."""
    by_height = sorted(spheres, key=lambda sphere: float(sphere.centre[1]))
    rows: list[list[Sphere]] = []
    for sphere in by_height:
        if rows and sphere.centre[1] - rows[-1][-1].centre[1] < sphere.radius:
            rows[-1].append(sphere)
        else:
            rows.append([sphere])
    return [
        sphere for row in rows for sphere in sorted(row, key=lambda sphere: float(sphere.centre[0]))
    ]
