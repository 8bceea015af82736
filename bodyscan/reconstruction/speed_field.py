"""A smooth field of speed along the rays of one camera, no larger than the evidence asks for."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from bodyscan.arrays import Array, Indices, Mask
from bodyscan.geometry.scaled_systems import gram, invert_scaled, solve_scaled
from bodyscan.reconstruction.surface_cells import Cells

KNOT_MM, REACH_MM = 80.0, 150.0
"""Distance of knots, about a limb's width, and correlation length of speeds (part of a trunk)."""
SIZES = np.geomspace(0.02, 50.0, 40)
"""Standard deviations tried for the field, mm per unit of time."""
SIGMAS = 3.0
"""A remainder counts if noise alone exceeds it about once in several hundred times."""


@dataclass(frozen=True, eq=False)
class CellSpeeds:
    """What the cells say, (cells,) each.

    speed: along the rays, mm per unit of time.
    weight: 1/variance of the speed, 0 where nothing is known.
    by_twist: derivatives by a twist, (cells, 6).
    """

    speed: Array
    weight: Array
    by_twist: Array


@dataclass(frozen=True, eq=False)
class Knots:
    """Knots of the field.

    share: weight of each knot in the middle of each cell, linear in between, (cells, knots).
    akin: prior correlation of their speeds, (knots, knots).
    """

    share: Array
    akin: Array

    @staticmethod
    def over(cells: Cells, known: Mask, mm_per_px: float) -> Knots:
        """Knots with evidence; known: cells with a speed, (cells,); mm_per_px: on the surface."""
        step = KNOT_MM / mm_per_px
        columns, rows = (
            np.arange(np.ceil(size / step) + 1.0) * step for size in (cells.width, cells.height)
        )
        across, down = (
            np.maximum(1.0 - np.abs((middles[:, None] - places) / step), 0.0)
            for middles, places in zip(cells.middles, (columns, rows), strict=True)
        )
        share = np.einsum("ij,kl->ikjl", down, across).reshape(cells.count, -1)
        used: Indices = np.flatnonzero(share[known].sum(axis=0) > 0.0)
        place = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)[used] * mm_per_px
        apart = np.linalg.norm(place[:, None] - place, axis=-1)
        return Knots(share[:, used], np.exp(-apart / REACH_MM))


@dataclass(frozen=True, eq=False)
class FieldFit:
    """A twist (6,) and speeds of the knots (K,), with their joint covariance (6 + K, 6 + K).

    explained: reduction of chi-square by the twist.
    is_bent: whether there is a field at all.
    """

    twist: Array
    field: Array
    covariance: Array
    explained: float
    is_bent: bool

    def speed(self, cells: CellSpeeds, knots: Knots) -> Array:
        """(cells,), mm per unit of time."""
        return np.asarray(cells.by_twist @ self.twist + knots.share @ self.field, np.float64)

    def variance(self, cells: CellSpeeds, knots: Knots) -> Array:
        """Variance of the speed, (cells,)."""
        jacobian = np.hstack([cells.by_twist, knots.share])
        return np.asarray(np.sum((jacobian @ self.covariance) * jacobian, axis=1), np.float64)


def fit_field(cells: CellSpeeds, knots: Knots, twist_sigmas: Array, *, bent: float) -> FieldFit:
    """Fit twist and field together; the field is 0 where there is no evidence for one.

    twist_sigmas: prior sigmas of the twist, (6,).
    bent: twice the log likelihood ratio from which a field is taken to exist.

    The field's size is the one that makes the observations likeliest, with all other unknowns
    integrated out.
    """
    problem = _Problem.of(cells, knots, twist_sigmas)
    gains = problem.gains(SIZES)
    best = int(np.argmax(gains))
    is_bent = bool(2.0 * gains[best] > bent)
    normal, used = problem.normal, slice(0, None if is_bent else 6)
    if is_bent:
        normal = normal.copy()
        normal[6:, 6:] += invert_scaled(knots.akin * SIZES[best] ** 2)
    covariance, found = np.zeros(normal.shape), np.zeros(len(normal))
    covariance[used, used] = invert_scaled(normal[used, used])
    found[used] = covariance[used, used] @ problem.right[used]
    explained = problem.right[:6] @ solve_scaled(problem.normal[:6, :6], problem.right[:6])
    return FieldFit(found[:6], found[6:], covariance, float(explained), is_bent)


def unexplained(cells: CellSpeeds, knots: Knots, left: Array) -> Array:
    """Variance of speed (cells,), (mm per unit of time)^2, beyond noise in the residuals `left`.

    left: (cells,); each cell's variance is that of the residuals around it.
    """
    known = cells.weight > 0.0
    share, weight = knots.share[known], cells.weight[known]
    count = share.sum(axis=0)
    square = share.T @ (weight * left[known] ** 2)
    beyond = square - count > SIGMAS * np.sqrt(2.0 * count)
    variance = np.where(beyond, (square - count) / np.maximum(share.T @ weight, 1e-300), 0.0)
    return np.asarray(knots.share @ variance, np.float64)


@dataclass(frozen=True, eq=False)
class _Problem:
    """Normal equations of twist and field without the field's prior; the knots' correlations."""

    normal: Array
    right: Array
    akin: Array

    @staticmethod
    def of(cells: CellSpeeds, knots: Knots, twist_sigmas: Array) -> _Problem:
        known = cells.weight > 0.0
        jacobian = np.hstack([cells.by_twist[known], knots.share[known]])
        weighted = jacobian * cells.weight[known, None]
        normal = gram(weighted, jacobian)
        normal[range(6), range(6)] += twist_sigmas**-2.0
        return _Problem(normal, weighted.T @ cells.speed[known], knots.akin)

    def gains(self, sizes: Array) -> Array:
        """Log likelihood ratios of the observations with fields of these sizes against none."""
        rest, power = self._beside_twist
        variance = sizes[:, None] ** 2
        seen = 1.0 + variance * power
        return np.asarray(0.5 * np.sum(variance * rest**2 / seen - np.log(seen), axis=1))

    @cached_property
    def _beside_twist(self) -> tuple[Array, Array]:
        """Gradient and curvature (K,) of the field's independent parts, the twist projected out."""
        by_twist = solve_scaled(self.normal[:6, :6], self.normal[:6].T).T
        normal = self.normal[6:, 6:] - self.normal[6:, :6] @ by_twist[:, 6:]
        right = self.right[6:] - self.normal[6:, :6] @ solve_scaled(
            self.normal[:6, :6], self.right[:6]
        )
        root = np.linalg.cholesky(self.akin)
        power, parts = np.linalg.eigh(root.T @ normal @ root)
        return parts.T @ root.T @ right, np.maximum(power, 0.0)
