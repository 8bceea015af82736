"""Read the artefacts of an acceptance test from points: spheres and a plate of known size.

The figures are modelled on VDI/VDE 2634 parts 2 and 3 and on ISO 20685-2. What is computed is
stated here; it is not a test by these standards, which require more (artefacts, places, operators).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations

import numpy as np
from scipy import ndimage
from scipy.spatial import ConvexHull
from scipy.spatial.distance import pdist

from bodyscan.arrays import Array, Mask
from bodyscan.errors import FailedWork
from bodyscan.evaluation.planes import best_plane
from bodyscan.evaluation.sphere_search import find_spheres
from bodyscan.evaluation.spheres import Sphere, fit_sphere
from bodyscan.geometry.robust import rms

REJECTED = 0.003
"""Share of the points, the farthest off, that may be left out, as VDI/VDE 2634 allows."""
SHELL_SHARE = 0.9
"""ISO 20685-2 asks for the shell that holds nine tenths of the points."""
OWN = 0.15
"""Points farther off a sphere's surface than this, in radii, do not belong to it."""
FACING = 0.8
"""Nor do points whose normal is farther than 37 degrees from the radius: a stand, a rim."""
TRIES, TRY_POINTS = 600, 3000
NEAR_PLATE_MM, RIM_MM, CELL_MM = 4.0, 12.0, 10.0
FEWEST_ON_PLATE = 300
ROUND, NOISE_SHELL_MM = 0.05, 2.0
"""A sphere's shell may be so many radii wide, or so many mm, the noise of a poor pair. What is most
like a sphere on a person has a tenth of a radius."""
FLAT_MM = 1.2
"""Points anywhere within NEAR_PLATE_MM of a plane have an RMS of 2.3 mm, and a person's back 2.2: what
has more than half of that is no plate."""


@dataclass(frozen=True, eq=False)
class SphereReading:
    """One sphere, from points (all pairs merged, or one pair's).

    fitted: the best sphere.
    points: number of points on it.
    form_mm: range of the radial distances from it, 3 per mille of the points left out.
    shell_mm: width of the shell that holds 90 % of the points.
    size_mm: its diameter less the calibrated one.
    """

    fitted: Sphere
    points: int
    form_mm: float
    shell_mm: float
    size_mm: float


@dataclass(frozen=True, eq=False)
class PlateReading:
    """One plate.

    points: number of points on it.
    flatness_mm: range of the distances from the best plane, 3 per mille left out.
    rms_mm: RMS of all distances.
    area_mm2: of the hull of what was measured, before its rim was left out.
    """

    points: int
    flatness_mm: float
    rms_mm: float
    area_mm2: float


def locate_spheres(
    points: Array, normals: Array, radius_mm: float, centres_mm: Array
) -> list[Sphere]:
    """Find the artefact's spheres, in its order, among points (N, 3) with outward normals.

    Raises FailedWork if not all are found.
    """
    found = find_spheres(points[None], normals[None], radius_mm, len(centres_mm))
    wanted = pdist(centres_mm)
    places = np.stack([sphere.centre for sphere in found])
    order = min(
        permutations(range(len(found))),
        key=lambda some: float(np.sum((pdist(places[list(some)]) - wanted) ** 2)),
    )
    return [found[k] for k in order]


def read_sphere(points: Array, normals: Array, near: Sphere, radius_mm: float) -> SphereReading:
    """Read the sphere `near` a place, from those of points (N, 3) that belong to it.

    Raises FailedWork if there are too few.
    """
    arm = points - near.centre
    length = np.linalg.norm(arm, axis=1)
    own = np.abs(length - radius_mm) < OWN * radius_mm
    own &= np.einsum("nc,nc->n", arm, normals) > FACING * length
    fitted = fit_sphere(points[own])
    off = _drop_farthest(fitted.distances(points[own]))
    return SphereReading(
        fitted,
        int(own.sum()),
        float(np.ptp(off)),
        _shell(off),
        2.0 * (fitted.radius - radius_mm),
    )


def require_spheres(readings: Sequence[SphereReading], radius_mm: float, centres_mm: Array) -> None:
    """Raise FailedWork if what was read in the spheres' place is something else.

    A rig may be so wrong that its spheres are refused here; the error says by how much.
    """
    remedy = "does the folder show the artefact, and does ARTEFACT.yaml describe it?"
    widest = max(ROUND * radius_mm, NOISE_SHELL_MM)
    for k, one in enumerate(readings, start=1):
        if one.shell_mm > widest:
            raise FailedWork(
                f"sphere {k} of radius {radius_mm:g} mm was not found: what is most like it lies in a "
                f"shell of {one.shell_mm:.1f} mm, and a sphere within {widest:.1f}",
                remedy=remedy,
            )
    errors = spacing_errors(readings, centres_mm)
    worst = float(errors[np.argmax(np.abs(errors))]) if len(errors) else 0.0
    if abs(worst) > radius_mm:
        raise FailedWork(
            f"the spheres were not found: two of what is most like them are {abs(worst):.0f} mm too "
            f"{'far apart' if worst > 0.0 else 'close'}, more than a radius",
            remedy=remedy,
        )


def spacing_errors(readings: Sequence[SphereReading], centres_mm: Array) -> Array:
    """(K,) mm: distances of the spheres' centres less the calibrated ones, for every two."""
    return pdist(np.stack([one.fitted.centre for one in readings])) - pdist(centres_mm)


def read_plate(points: Array, normals: Array) -> PlateReading:
    """Read the largest plane among points (N, 3) with normals, which may face either side.

    Its rim and everything not joined to it are left out. Raises FailedWork if there is none.
    """
    if len(points) < FEWEST_ON_PLATE:
        raise FailedWork(f"{len(points)} points are too few for a plate")
    normal, offset = _largest_plane(points, np.random.default_rng(0))
    for _ in range(3):
        near = np.abs(points @ normal - offset) < NEAR_PLATE_MM
        near &= np.abs(normals @ normal) > FACING
        if near.sum() < FEWEST_ON_PLATE:
            raise FailedWork("no plate is among the points")
        normal, offset = best_plane(points[near])
    on_plate = points[near]
    flat = on_plate @ _in_plane(normal)
    joined = _largest_piece(flat)
    inside, area = _within_rim(flat[joined])
    kept = on_plate[joined][inside]
    if len(kept) < FEWEST_ON_PLATE:
        raise FailedWork("no plate is among the points")
    normal, offset = best_plane(kept)
    off = kept @ normal - offset
    if rms(off) > FLAT_MM:
        raise FailedWork(
            f"no plate is among the points: what is most like one is {rms(off):.1f} mm RMS off a plane",
            remedy="does the folder show the plate?",
        )
    return PlateReading(len(kept), float(np.ptp(_drop_farthest(off))), rms(off), area)


def _drop_farthest(off: Array) -> Array:
    """Signed distances (N,) without the 3 per mille that are largest."""
    size = np.abs(off)
    return off[np.argsort(size, kind="stable")[: max(1, round((1.0 - REJECTED) * len(off)))]]


def _shell(off: Array) -> float:
    """Width of the narrowest interval that holds nine tenths of the distances (N,)."""
    ordered = np.sort(off)
    held = max(1, round(SHELL_SHARE * len(ordered)))
    return float(np.min(ordered[held - 1 :] - ordered[: len(ordered) - held + 1]))


def _largest_plane(points: Array, rng: np.random.Generator) -> tuple[Array, float]:
    """The plane through three points that most points lie near (Fischler and Bolles 1981)."""
    some = points[rng.choice(len(points), min(TRY_POINTS, len(points)), replace=False)]
    a, b, c = np.moveaxis(some[rng.integers(0, len(some), (TRIES, 3))], 1, 0)
    normals = np.cross(b - a, c - a)
    doubled_area = np.linalg.norm(normals, axis=1, keepdims=True)
    wide = doubled_area[:, 0] > CELL_MM**2  # three in one place or line: no plane
    normals, a = normals[wide] / doubled_area[wide], a[wide]
    if not len(normals):
        raise FailedWork("no plate is among the points")
    offsets = np.einsum("kc,kc->k", normals, a)
    votes = np.sum(np.abs(some @ normals.T - offsets) < NEAR_PLATE_MM, axis=0)
    best = int(np.argmax(votes))
    return normals[best], float(offsets[best])


def _in_plane(normal: Array) -> Array:
    """(3, 2): two perpendicular unit vectors in the plane."""
    right = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(normal, right)], axis=1)


def _largest_piece(flat: Array) -> Mask:
    """Which flat points (N, 2) belong to the largest piece, whose cells touch, (N,)."""
    cells = np.floor((flat - flat.min(axis=0)) / CELL_MM).astype(np.int64)
    taken = np.zeros(cells.max(axis=0) + 1, bool)
    taken[tuple(cells.T)] = True
    piece = ndimage.label(taken, np.ones((3, 3)))[0][tuple(cells.T)]
    return np.asarray(piece == np.argmax(np.bincount(piece)))


def _within_rim(flat: Array) -> tuple[Mask, float]:
    """Which flat points (N, 2) lie inside their hull's rim, (N,), and the hull's area."""
    hull = ConvexHull(flat)
    inward = -(flat @ hull.equations[:, :2].T + hull.equations[:, 2])
    return inward.min(axis=1) > RIM_MM, float(hull.volume)
