"""Overlaps of range images: their matches, normal equations, and the joint step of all poses."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import permutations
from typing import TypeVar

import numpy as np

from bodyscan.alignment.matching import (
    NARROW_MARGIN_PX,
    Matches,
    SampledPoints,
    match_projected,
    sample_points,
)
from bodyscan.arrays import Array, Mask
from bodyscan.geometry.linear_gaussian import LinearGaussianSystem
from bodyscan.geometry.robust import estimate_robust_scale
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.progress import map_threads
from bodyscan.reconstruction.range_image import RangeImage

Result = TypeVar("Result")

COARSE = slice(None, None, 4)
"""The points used in early rounds of alignment."""


@dataclass(frozen=True, eq=False)
class OverlapPoints:
    """Sampled points of one range image."""

    inner: SampledPoints  # away from its margins
    # The same points nearly up to the margins, for images that share nothing more.
    whole: SampledPoints

    @staticmethod
    def from_image(image: RangeImage, spacing_mm: float) -> OverlapPoints:
        return OverlapPoints(*sample_points(image, spacing_mm, (4, NARROW_MARGIN_PX)))

    def select(self, chosen: Mask | slice) -> OverlapPoints:
        return OverlapPoints(self.inner.select(chosen), self.whole.select(chosen))

    def with_geometry(self, points: Array, normals: Array) -> OverlapPoints:
        """Replace points and normals, (N, 3) each."""
        inner, whole = (
            replace(part, points=points, normals=normals) for part in (self.inner, self.whole)
        )
        return OverlapPoints(inner, whole)


def match_overlap(
    source: OverlapPoints,
    target: OverlapPoints,
    rig_from_source: RigidTransform,
    rig_from_target: RigidTransform,
    reach_mm: float,
    min_matches: int,
) -> Matches | None:
    """Match the inner parts, or, if these have fewer than `min_matches`, everything up to the margins.

    Matches in the margins have larger sigmas. None if those are too few as well.
    """
    poses = rig_from_source, rig_from_target, reach_mm
    matches = match_projected(source.inner, target.inner, *poses)
    if len(matches.distances) < min_matches:
        whole = match_projected(source.whole, target.whole, *poses)
        matches = replace(whole, sigma_mm=np.hypot(whole.sigma_mm, 0.3))  # bias by blur
    return matches if len(matches.distances) >= min_matches else None


def map_overlaps(
    count: int, measure: Callable[[int, int], Result | None]
) -> dict[tuple[int, int], Result]:
    """Call `measure` for each of `count` images as source and each other as target; drop None.

    Both directions are used, so that errors of one direction on curved surfaces cancel.
    """
    index_pairs = list(permutations(range(count), 2))
    results = map_threads(lambda both: measure(*both), index_pairs)
    return {
        both: result
        for both, result in zip(index_pairs, results, strict=True)
        if result is not None
    }


def linearize(matches: Matches, correlated: float) -> LinearGaussianSystem:
    """Normal equations of one overlap for the source's twist (6,); the target's acts oppositely.

    Point-to-plane distances with Cauchy weights, at the present poses.

    correlated: number of neighbouring matches that count as one.
    """
    jacobian = np.hstack([np.cross(matches.points, matches.normals), matches.normals])
    weights = weigh_by_cauchy(matches) / correlated
    return LinearGaussianSystem.from_observations(jacobian, -matches.distances, weights)


def weigh_by_cauchy(matches: Matches) -> Array:
    """Weights (M,): 1 / (1 + (d / 2 sigma)^2) / sigma^2. sigma^2 is the sum of a match's expected
    variance and the robust variance of all distances, at least 0.01 mm: surfaces of two calibrations
    never agree better."""
    scale_mm = estimate_robust_scale(matches.distances, 0.01)
    variance = matches.sigma_mm**2 + scale_mm * scale_mm
    return 1.0 / (variance + 0.25 * matches.distances**2)


def solve_motions(
    overlaps: Mapping[tuple[int, int], LinearGaussianSystem], motion: Array, covariance: Array
) -> Array:
    """Solve for the twists (P, 6) of all pairs in one Gauss-Newton step with a Gaussian prior.

    overlaps: by source and target, linearized at `motion` (P, 6).
    covariance: of the prior, whose mean is zero, (6P, 6P).
    """
    return _assemble_system(overlaps, motion, covariance).solve().reshape(-1, 6)


def compute_motion_covariance(
    overlaps: Mapping[tuple[int, int], LinearGaussianSystem], covariance: Array
) -> Array:
    """Posterior covariance (6P, 6P) of the twists that `solve_motions` finds."""
    motion = np.zeros((len(covariance) // 6, 6))
    return _assemble_system(overlaps, motion, covariance).covariance()


def _assemble_system(
    overlaps: Mapping[tuple[int, int], LinearGaussianSystem], motion: Array, covariance: Array
) -> LinearGaussianSystem:
    """The prior and all overlaps, as one system of all twists."""
    parts = []
    for (a, b), overlap in overlaps.items():
        h = overlap.information
        # Linearized distance: d + J (x_a - m_a) - J (x_b - m_b).
        offset = h @ (motion[a] - motion[b]) + overlap.vector
        information = np.block([[h, -h], [-h, h]])
        system = LinearGaussianSystem(information, np.hstack([offset, -offset]))
        parts.append((np.hstack([6 * a + np.arange(6), 6 * b + np.arange(6)]), system))
    prior = LinearGaussianSystem.from_prior(np.asarray(np.linalg.inv(covariance), np.float64))
    return prior + LinearGaussianSystem.assemble(parts, motion.size)
