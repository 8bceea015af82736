"""Find spheres of a known radius in a range image, by votes for their centres."""

from __future__ import annotations

import numpy as np

from bodyscan.arrays import Array
from bodyscan.errors import FailedWork
from bodyscan.evaluation.planes import best_plane
from bodyscan.evaluation.spheres import FEWEST_POINTS, Sphere, fit_sphere
from bodyscan.geometry.robust import robust_scale

VOTE_CELL = 0.2  # radii: size of a cell in which votes for a centre are counted
TAKEN = 1.15  # radii from a centre within which points belong to no other sphere
OFF_SURFACE = 0.15  # radii by which a sphere's own points may lie off its surface
ROUNDER = 0.5  # largest misfit of a sphere relative to a plane's


def find_spheres(points: Array, normals: Array, radius: float, count: int) -> list[Sphere]:
    """The `count` spheres of one radius in a range image, numbered from top left to bottom right.

    points, normals: (H, W, 3), normals towards the camera, NaN where nothing was measured.

    Every point votes for the place one radius behind it, and centres are where votes gather. Raises
    FailedWork if fewer are found.
    """
    flat, votes = points.reshape(-1, 3), (points - radius * normals).reshape(-1, 3)
    known = np.isfinite(votes).all(axis=1)
    flat, votes = flat[known].astype(float), votes[known].astype(float)
    found: list[Sphere] = []
    for _ in range(count):
        sphere = _find_sphere(flat, votes, radius)
        if sphere is None:
            raise FailedWork(
                f"{len(found)} spheres of radius {radius:g} mm found, {count} were expected",
                remedy="see that all spheres are in the picture and lit",
            )
        found.append(sphere)
        left = np.linalg.norm(flat - sphere.centre, axis=1) > TAKEN * radius
        flat, votes = flat[left], votes[left]
    return _in_reading_order(found)


def _find_sphere(points: Array, votes: Array, radius: float) -> Sphere | None:
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
    flat = robust_scale(own @ normal - offset)
    # Ground between the spheres gathers votes too, but a plane fits it better.
    return sphere if robust_scale(sphere.distances(own)) < ROUNDER * flat else None


def _in_reading_order(spheres: list[Sphere]) -> list[Sphere]:
    """Rows from the top of the image down, each from left to right.

    A row ends where the next sphere is more than a radius lower.
    """
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
