"""Whether points' own sigmas are honest: errors of depth over sigma, on known surfaces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodyscan.arrays import Array, Mask
from bodyscan.geometry.ray_depths import intersect_rays
from bodyscan.geometry.robust import rms
from bodyscan.laboratory.chapter.captures import ChapterCaptures, SceneCapture
from bodyscan.laboratory.rivals.approaches import Approach


@dataclass(frozen=True)
class PointSigma:
    """Errors of depth over their sigma.

    spheres, plate: root mean square on these (1 if the sigmas are honest).
    beyond_three: share of all errors beyond three sigmas (0.0027 if Gaussian).
    median_mm: of the sigmas themselves.
    """

    name: str
    spheres: float
    plate: float
    beyond_three: float
    median_mm: float


def point_sigma(approach: Approach, captures: ChapterCaptures) -> PointSigma:
    """Compare sigmas, from decoding noise and the sheets'
    covariance, with the true depth errors."""
    parts = (
        _errors(approach, captures.spheres, captures.owner >= 0),
        _errors(approach, captures.plate, captures.on_plate),
    )
    spheres, plate = (error / sigma for error, sigma in parts)
    every = np.concatenate([spheres, plate])
    return PointSigma(
        approach.name,
        rms(spheres),
        rms(plate),
        float(np.mean(np.abs(every) > 3.0)),
        float(np.median(np.concatenate([sigma for _, sigma in parts]))),
    )


def _errors(approach: Approach, seen: SceneCapture, where: Mask) -> tuple[Array, Array]:
    """Error of depth and its sigma, mm, of the measured pixels among `where` (H, W)."""
    rows, columns = np.nonzero(where & np.isfinite(seen.stripes.s))
    rays = approach.camera.rays(np.column_stack([columns, rows]).astype(float))
    measured = intersect_rays(approach.sheets, rays, seen.stripes.s[rows, columns].astype(float))
    decoding = measured.per_stripe * seen.stripes.sigma[rows, columns]
    sigma = np.sqrt(decoding**2 + measured.variance_mm2)
    error = measured.depth - seen.truth.depth[rows, columns]
    known = np.isfinite(error) & np.isfinite(sigma)
    return error[known], sigma[known]
