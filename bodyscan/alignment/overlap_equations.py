"""Normal equations of the overlaps, and the step that solves them for all pairs together."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from bodyscan.alignment.matching import Matches
from bodyscan.arrays import Array
from bodyscan.compiled import compiled
from bodyscan.geometry.linear_gaussian import invert_scaled, solve_scaled
from bodyscan.geometry.robust import robust_scale

LEAST_SPREAD_MM = 0.01


@dataclass(frozen=True, eq=False)
class OverlapEquations:
    """Normal equations of one overlap.

    With d the distances of matches and J their Jacobian by the source's motion; the target's motion
    has the opposite effect.

    information: J^T W J, (6, 6).
    gradient: J^T W d, (6,).
    """

    information: Array
    gradient: Array

    @staticmethod
    def of(matches: Matches, correlated: float) -> OverlapEquations:
        """Sum up the matches; distances far beyond their robust sigma count for little (Cauchy).

        correlated: number of matches that count as one.
        """
        information, gradient = np.zeros((6, 6)), np.zeros(6)
        distances = matches.distances
        spots = (matches.points, matches.normals, distances)
        _accumulate(*spots, match_weights(matches), information, gradient)
        return OverlapEquations(information / correlated, gradient / correlated)


def match_weights(matches: Matches) -> Array:
    """(M,) Cauchy's weights, 1 / (1 + (d / 2 sigma)^2), over sigma^2, which holds what the distances
    spread by besides."""
    spread_mm = robust_scale(matches.distances, LEAST_SPREAD_MM)
    variance = matches.sigma_mm**2 + spread_mm * spread_mm
    return 1.0 / (variance + 0.25 * matches.distances**2)


def solve_motions(
    overlaps: Mapping[tuple[int, int], OverlapEquations], motion: Array, covariance: Array
) -> Array:
    """Motions (P, 6) by one step: matches pull pairs together, the prior holds them near zero.

    One step is enough, since every round of the alignment matches anew.
    """
    right = np.zeros(motion.size)
    for (a, b), overlap in overlaps.items():
        # The distance left after the step: d + J (x_i - m_i) - J (x_j - m_j).
        wanted = overlap.information @ (motion[a] - motion[b]) - overlap.gradient
        right[6 * a : 6 * a + 6] += wanted
        right[6 * b : 6 * b + 6] -= wanted
    return solve_scaled(_normal(overlaps, covariance), right).reshape(-1, 6)


def motion_covariance(
    overlaps: Mapping[tuple[int, int], OverlapEquations], covariance: Array
) -> Array:
    """Covariance (6P, 6P) of the motions that `solve_motions` finds, given that of the prior."""
    return invert_scaled(_normal(overlaps, covariance))


def _normal(overlaps: Mapping[tuple[int, int], OverlapEquations], covariance: Array) -> Array:
    """Normal matrix (6P, 6P) of all motions: the prior's, and each overlap's by both of its ends."""
    normal = np.asarray(np.linalg.inv(covariance), np.float64)
    for (a, b), overlap in overlaps.items():
        i, j = slice(6 * a, 6 * a + 6), slice(6 * b, 6 * b + 6)
        normal[i, i] += overlap.information
        normal[j, j] += overlap.information
        normal[i, j] -= overlap.information
        normal[j, i] -= overlap.information
    return normal


@compiled
def _accumulate(
    points: Array,
    normals: Array,
    distances: Array,
    weights: Array,
    information: Array,
    gradient: Array,
) -> None:
    """Add distances (M,) along normals (M, 3) at points (M, 3) to the normal equations."""
    jacobian = np.empty(6)
    for n in range(len(distances)):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        a, b, c = normals[n, 0], normals[n, 1], normals[n, 2]
        jacobian[0], jacobian[1], jacobian[2] = y * c - z * b, z * a - x * c, x * b - y * a
        jacobian[3], jacobian[4], jacobian[5] = a, b, c
        for i in range(6):
            weighted = weights[n] * jacobian[i]
            gradient[i] += weighted * distances[n]
            for j in range(6):
                information[i, j] += weighted * jacobian[j]
