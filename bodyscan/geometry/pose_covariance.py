"""How well the joint solve knows each pose: the covariance of all pairs in the rig frame."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from bodyscan.arrays import Array
from bodyscan.geometry.transforms import twist_jacobian


@dataclass(frozen=True, eq=False)
class PoseCovariance:
    """Joint covariance (6P, 6P) of small motions of the pairs `names`, rig frame.

    A motion is a rotation vector (radians) about the rig's origin, then a translation (mm).
    """

    names: tuple[str, ...]
    matrix: Array

    def of(self, name: str) -> Array:
        """(6, 6) of one pair's motion."""
        k = 6 * self.names.index(name)
        return self.matrix[k : k + 6, k : k + 6]

    def among(self, names: Sequence[str]) -> Array:
        """(6N, 6N) of these pairs' motions, in their order."""
        first = np.array([6 * self.names.index(name) for name in names], int)
        rows = (first[:, None] + np.arange(6)).ravel()
        return self.matrix[np.ix_(rows, rows)]

    def plus(self, names: Iterable[str], own: Array) -> PoseCovariance:
        """With (6, 6) more of each of these pairs, by itself."""
        matrix = self.matrix.copy()
        for name in names:
            k = 6 * self.names.index(name)
            matrix[k : k + 6, k : k + 6] += own
        return PoseCovariance(self.names, matrix)

    def between(self, a: str, b: str) -> Array:
        """(6, 6) of the motion of b relative to a."""
        i, j = 6 * self.names.index(a), 6 * self.names.index(b)
        m = self.matrix
        rows_i, rows_j = slice(i, i + 6), slice(j, j + 6)
        cross = m[rows_i, rows_j]
        return m[rows_i, rows_i] + m[rows_j, rows_j] - cross - cross.T


def point_covariance(motion_covariance: Array, point: Array) -> Array:
    """(3, 3) mm2: how a rig point (3,) carried by such a motion (6, 6) is spread."""
    jacobian = twist_jacobian(point[None])[0]
    return jacobian @ motion_covariance @ jacobian.T


def position_sigma(covariance: PoseCovariance, name: str, position: Array) -> Array:
    """(3,) mm: standard deviation, along the rig's axes, of what the pair puts at `position` (3,), such
    as its camera's centre."""
    return np.sqrt(np.diag(point_covariance(covariance.of(name), position)))
