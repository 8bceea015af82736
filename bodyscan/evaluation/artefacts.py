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
from scipy.linalg import null_space
from scipy.spatial import ConvexHull
from scipy.spatial.distance import pdist

from bodyscan.arrays import Array, Mask
from bodyscan.errors import FailedWork
from bodyscan.evaluation.primitives import Sphere, find_spheres, fit_plane, fit_sphere
from bodyscan.geometry.robust import rms

MIN_COSINE = 0.8
"""Between a point's normal and the artefact's, 37 degrees: others are of a stand or a rim."""
PLATE_REACH_MM = 4.0
MIN_PLATE_POINTS = 300


@dataclass(frozen=True, eq=False)
class SphereReading:
    """One sphere, from points (all pairs merged, or one pair's)."""

    fitted: Sphere
    points: int
    # Range of the radial distances from the fitted one, 3 per mille of the points left out.
    form_mm: float
    shell_mm: float  # width of the shell that holds 90 % of the points
    size_mm: float  # its diameter less the calibrated one


@dataclass(frozen=True, eq=False)
class PlateReading:
    """One plate: number of its points, range of their distances from the best plane (3 per mille
    left out) and RMS of all; area of the hull of what was measured."""

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
    centres = np.stack([sphere.centre for sphere in found])

    def misfit(order: tuple[int, ...]) -> float:
        return float(np.sum((pdist(centres[list(order)]) - wanted) ** 2))

    return [found[k] for k in min(permutations(range(len(found))), key=misfit)]


def read_sphere(points: Array, normals: Array, near: Sphere, radius_mm: float) -> SphereReading:
    """Read the sphere near one from points (N, 3). Raises FailedWork if too few belong to it."""
    arm = points - near.centre
    length = np.linalg.norm(arm, axis=1)
    inliers = np.abs(length - radius_mm) < 0.15 * radius_mm
    inliers &= np.einsum("nc,nc->n", arm, normals) > MIN_COSINE * length
    fitted = fit_sphere(points[inliers])
    residual = _drop_farthest(fitted.distances(points[inliers]))
    form_mm, size_mm = float(np.ptp(residual)), 2.0 * (fitted.radius - radius_mm)
    # The narrowest interval with nine tenths of the distances, as of ISO 20685-2.
    ordered, count = np.sort(residual), max(1, round(0.9 * len(residual)))
    shell_mm = float(np.min(ordered[count - 1 :] - ordered[: len(ordered) - count + 1]))
    return SphereReading(fitted, int(inliers.sum()), form_mm, shell_mm, size_mm)


def require_spheres(readings: Sequence[SphereReading], radius_mm: float, centres_mm: Array) -> None:
    """Raise FailedWork if what was read as spheres is something else.

    A rig may be so wrong that its spheres are refused here; the error says by how much.
    """
    remedy = "check that the folder shows the artefact, and that ARTEFACT.yaml describes it"
    # 2 mm is the noise of a poor pair; the roundest part of a person has a tenth of a radius.
    widest = max(0.05 * radius_mm, 2.0)
    for k, one in enumerate(readings, start=1):
        if one.shell_mm > widest:
            raise FailedWork(
                f"sphere {k} of radius {radius_mm:g} mm was not found: the best candidate lies in a "
                f"shell of {one.shell_mm:.1f} mm, and a sphere within {widest:.1f}",
                remedy=remedy,
            )
    errors = compute_spacing_errors(readings, centres_mm)
    worst = float(errors[np.argmax(np.abs(errors))]) if len(errors) else 0.0
    if abs(worst) > radius_mm:
        raise FailedWork(
            "the spheres could not be identified: the distance between two candidates is off by "
            f"{worst:+.0f} mm, more than one radius",
            remedy=remedy,
        )


def compute_spacing_errors(readings: Sequence[SphereReading], centres_mm: Array) -> Array:
    """(K,) mm: distances of the spheres' centres less the calibrated ones, for every two."""
    return pdist(np.stack([one.fitted.centre for one in readings])) - pdist(centres_mm)


def read_plate(points: Array, normals: Array) -> PlateReading:
    """Read the largest plane among points (N, 3) with normals, which may face either side.

    Its rim and everything not joined to it are left out. Raises FailedWork if there is none.
    """
    if len(points) < MIN_PLATE_POINTS:
        raise FailedWork(f"{len(points)} points are too few for a plate")
    normal, offset = _find_largest_plane(points, np.random.default_rng(0))
    for _ in range(3):
        near = np.abs(points @ normal - offset) < PLATE_REACH_MM
        near &= np.abs(normals @ normal) > MIN_COSINE
        if near.sum() < MIN_PLATE_POINTS:
            raise FailedWork("no plate found in the point cloud")
        normal, offset = fit_plane(points[near])
    on_plate = points[near]
    flat = on_plate @ null_space(normal[None])
    joined = _find_largest_piece(flat)
    hull = ConvexHull(flat[joined])
    inward = -(flat[joined] @ hull.equations[:, :2].T + hull.equations[:, 2])
    kept = on_plate[joined][inward.min(axis=1) > 12.0]  # mm from the rim
    if len(kept) < MIN_PLATE_POINTS:
        raise FailedWork("no plate found in the point cloud")
    normal, offset = fit_plane(kept)
    residual = kept @ normal - offset
    # Points anywhere within reach of a plane have 2.3 mm RMS, and a person's back 2.2.
    if rms(residual) > 1.2:
        raise FailedWork(
            "no plate found in the point cloud: the flattest surface is "
            f"{rms(residual):.1f} mm RMS off a plane",
            remedy="check that the folder shows the plate",
        )
    return PlateReading(
        len(kept), float(np.ptp(_drop_farthest(residual))), rms(residual), hull.volume
    )


def _drop_farthest(residual: Array) -> Array:
    """Signed distances (N,) without the 3 per mille that are largest, as VDI/VDE 2634 allows."""
    size = np.abs(residual)
    kept = max(1, round((1.0 - 0.003) * len(residual)))
    return residual[np.argsort(size, kind="stable")[:kept]]


def _find_largest_plane(points: Array, rng: np.random.Generator) -> tuple[Array, float]:
    """Find the plane through three points that most points lie near (RANSAC)."""
    some = points[rng.choice(len(points), min(3000, len(points)), replace=False)]
    a, b, c = np.moveaxis(some[rng.integers(0, len(some), (600, 3))], 1, 0)
    normals = np.cross(b - a, c - a)
    doubled_area = np.linalg.norm(normals, axis=1, keepdims=True)
    wide = doubled_area[:, 0] > 10.0**2  # three in one position or line: no plane
    normals, a = normals[wide] / doubled_area[wide], a[wide]
    if not len(normals):
        raise FailedWork("no plate found in the point cloud")
    offsets = np.einsum("kc,kc->k", normals, a)
    votes = np.sum(np.abs(some @ normals.T - offsets) < PLATE_REACH_MM, axis=0)
    best = int(np.argmax(votes))
    return normals[best], float(offsets[best])


def _find_largest_piece(flat: Array) -> Mask:
    """Which flat points (N, 2) belong to the largest piece of touching cells of 10 mm, (N,)."""
    cells = np.floor((flat - flat.min(axis=0)) / 10.0).astype(np.int64)
    occupied = np.zeros(cells.max(axis=0) + 1, bool)
    occupied[tuple(cells.T)] = True
    piece = ndimage.label(occupied, np.ones((3, 3)))[0][tuple(cells.T)]
    return np.asarray(piece == np.argmax(np.bincount(piece)))
