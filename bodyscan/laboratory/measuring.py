"""Accuracy of an approach on spheres and plate, and how well its sigmas describe it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from bodyscan.arrays import Array, Mask
from bodyscan.evaluation.primitives import (
    CentreDistances,
    Flatness,
    SphereAccuracy,
    compare_centre_distances,
    measure_flatness,
    measure_sphere,
)
from bodyscan.geometry.camera import camera_from_fields
from bodyscan.geometry.light_planes import Axis, RayDepths, orient_towards_camera
from bodyscan.geometry.light_sheets import intersect_rays
from bodyscan.geometry.robust import rms
from bodyscan.geometry.transforms import fit_rigid_transform
from bodyscan.laboratory import apparatus
from bodyscan.laboratory.apparatus import ChapterCaptures, ChapterSetup, SceneCapture
from bodyscan.laboratory.approaches import Approach
from bodyscan.simulation.files import describe_camera

Stripes = NDArray[np.floating[Any]]


@dataclass(frozen=True, eq=False)
class ApproachAccuracy:
    """Accuracy of one approach on the common images."""

    name: str
    # No. 1 to 5, from every measured pixel that a sphere covers and the projector lights.
    spheres: tuple[SphereAccuracy, ...]
    covered: tuple[float, ...]  # share of those pixels that were measured, for each sphere
    distances: CentreDistances  # between the spheres' centres (radius held), and their scale error
    plate: Flatness  # of the flat plate as decoded
    # RMS flatness error of the same plate with every pixel's stripe coordinate known exactly, so
    # that only the calibration's error is left.
    plate_systematic_mm: float

    @property
    def mean_e(self) -> float:
        """Mean of E over the spheres, given radius, mm^2."""
        return float(np.mean([sphere.e_given for sphere in self.spheres]))


def triangulate_pixels(approach: Approach, s: Stripes, where: Mask | None = None) -> Array:
    """Triangulate pixels where `where` (H, W) holds: (N, 3) mm, camera frame, NaN if unmeasured."""
    rows, columns = np.nonzero(np.ones(s.shape, bool) if where is None else where)
    rays = approach.camera.rays(np.column_stack([columns, rows]).astype(float))
    wanted = s[rows, columns].astype(float)
    known = np.isfinite(wanted)
    points = np.full(rays.shape, np.nan)
    depth = approach.sheets.intersect(rays[known], wanted[known]).depth
    points[known] = rays[known] * depth[:, None]
    return points


def measure_artefacts(
    approach: Approach, captures: ChapterCaptures, *, whole: bool = False
) -> ApproachAccuracy:
    """Measure spheres and plate. whole: use only the stripe number of each pixel, no fraction."""
    maps = [captures.spheres.stripes.s, captures.plate.stripes.s]
    # The chapter's instrument gives the middle of each stripe.
    spheres_s, plate_s = (np.floor(s) + 0.5 if whole else s for s in maps)
    on_spheres = captures.owner >= 0
    points, owner = triangulate_pixels(approach, spheres_s, on_spheres), captures.owner[on_spheres]
    found, covered = [], []
    for number in range(len(apparatus.CENTRES)):
        pixels = owner == number
        measured = _drop_unknown(points[pixels])
        found.append(measure_sphere(measured, apparatus.RADIUS_MM))
        covered.append(len(measured) / int(pixels.sum()))
    centres = np.stack([sphere.given.centre for sphere in found])
    return ApproachAccuracy(
        approach.name,
        tuple(found),
        tuple(covered),
        compare_centre_distances(centres, apparatus.CENTRES),
        measure_flatness(_drop_unknown(triangulate_pixels(approach, plate_s, captures.on_plate))),
        measure_flatness(
            _drop_unknown(triangulate_pixels(approach, captures.plate.truth.s, captures.on_plate))
        ).rms_mm,
    )


@dataclass(frozen=True, eq=False)
class TrueSheets:
    """The simulator's pixels light as exactly known sheets for triangulation, including smile."""

    kind: ClassVar[str] = "true"

    setup: ChapterSetup

    @property
    def direction(self) -> Axis:
        return apparatus.PROJECTOR.direction

    @property
    def stripes(self) -> int:
        return self.setup.projector.stripes

    def intersect(self, rays: Array, s: Array) -> RayDepths:
        """Intersect rays with the light; it is known exactly."""
        depth = self._depth(rays, s)
        per_stripe = (self._depth(rays, s + 1e-3) - depth) / 1e-3
        return RayDepths(depth, per_stripe, np.zeros(rays.shape[:-1]))

    def _depth(self, rays: Array, s: Array) -> Array:
        """Compute depths by the secant method, started at the planes without smile."""
        planes = self.setup.projector.plane(s)
        first = -planes[..., 3] / np.sum(planes[..., :3] * rays, axis=-1)
        light = self.setup.projector.stripe
        further = first + 0.1
        residual = light(rays * first[..., None]) - s
        with np.errstate(invalid="ignore", divide="ignore"):
            for _ in range(6):  # down to rounding
                next_residual = light(rays * further[..., None]) - s
                change = next_residual - residual
                step = np.where(change == 0.0, 0.0, next_residual * (further - first) / change)
                first, further, residual = further, further - step, next_residual
        return further

    def tangent_planes(self, s: Array) -> Array:
        """Compute planes that touch in the middle of the fan, where there is no smile."""
        return orient_towards_camera(self.setup.projector.plane(s))


def make_true_approach(setup: ChapterSetup) -> Approach:
    """Make an approach of the simulator's own camera and light."""
    return Approach(
        "true calibration", camera_from_fields(describe_camera(apparatus.CAMERA)), TrueSheets(setup)
    )


def _drop_unknown(points: Array) -> Array:
    return points[np.isfinite(points[..., 2])]


@dataclass(frozen=True)
class PointSigma:
    """Errors along the rays over their sigma, after the rigid motion that fits best: a pair by itself
    has no frame but that of its boards.
    """

    name: str
    # spheres, plate: root mean square on these (1 if the sigmas are right).
    spheres: float
    plate: float
    beyond_three: float  # share of all errors beyond three sigmas (0.0027 if Gaussian)
    median_mm: float  # of the sigmas themselves


def compare_point_sigmas(approach: Approach, captures: ChapterCaptures) -> PointSigma:
    """Compare errors with their sigmas from decoding noise and the sheets' covariance."""
    parts = (
        _measure_points(approach, captures.spheres, captures.owner >= 0),
        _measure_points(approach, captures.plate, captures.on_plate),
    )
    measured, true = (np.concatenate([part[k] for part in parts]) for k in (0, 1))
    sigma = np.concatenate([part[2] for part in parts])
    aligned = fit_rigid_transform(measured, true).apply(measured)
    every = (aligned - true)[:, 2] / sigma
    spheres, plate = np.split(every, [len(parts[0][2])])
    return PointSigma(
        approach.name,
        rms(spheres),
        rms(plate),
        float(np.mean(np.abs(every) > 3.0)),
        float(np.median(sigma)),
    )


def _measure_points(
    approach: Approach, capture: SceneCapture, where: Mask
) -> tuple[Array, Array, Array]:
    """Measured pixels in `where` (H, W): points (N, 3), true points, sigmas of the depths (N,), mm."""
    rows, columns = np.nonzero(where & np.isfinite(capture.stripes.s))
    pixels = np.column_stack([columns, rows]).astype(float)
    rays = approach.camera.rays(pixels)
    measured = intersect_rays(approach.sheets, rays, capture.stripes.s[rows, columns].astype(float))
    decoding = measured.per_stripe * capture.stripes.sigma[rows, columns]
    sigma = np.sqrt(decoding**2 + measured.variance_mm2)
    true_camera = camera_from_fields(describe_camera(apparatus.CAMERA))
    true = true_camera.rays(pixels) * capture.truth.depth[rows, columns][:, None]
    points = rays * measured.depth[:, None]
    known = np.isfinite(points[:, 2]) & np.isfinite(true[:, 2]) & np.isfinite(sigma)
    return points[known], true[known], sigma[known]
