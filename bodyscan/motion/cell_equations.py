"""Normal equations of an overlap for affine displacements of the body's cells."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bodyscan.alignment.matching import Matches
from bodyscan.alignment.overlaps import weigh_by_cauchy
from bodyscan.arrays import Array, Indices
from bodyscan.compiled import compiled
from bodyscan.geometry.linear_gaussian import LinearGaussianSystem


@dataclass(frozen=True, eq=False)
class CellEquations:
    """Normal equations of an overlap, cell by cell."""

    cells: Indices  # those in which the pairs overlap, (c,)
    # Of the first pair's displacement field (12,) in each of them, a stack (c,); see
    # `build_rigid_fields`. The second pair's acts oppositely.
    system: LinearGaussianSystem

    @staticmethod
    def from_matches(
        matches: Matches, cell: Indices, centres: Array, correlated: float
    ) -> CellEquations:
        """Sum the matches by cell (M,), weighted as in `overlaps.linearize`."""
        occupied = np.bincount(cell, minlength=len(centres)) > 0
        cells, number = np.flatnonzero(occupied), (np.cumsum(occupied) - 1)[cell]
        information = np.zeros((len(cells), 12, 12))
        gradient = np.zeros((len(cells), 12))
        _accumulate(
            number,
            (matches.points - centres[cell], matches.normals),
            matches.distances,
            weigh_by_cauchy(matches),
            (information, gradient),
        )
        information += np.swapaxes(np.tril(information, -1), 1, 2)
        system = LinearGaussianSystem(information / correlated, -gradient / correlated)
        return CellEquations(cells, system)

    def swap(self) -> CellEquations:
        """Exchange the first and the second pair."""
        system = LinearGaussianSystem(self.system.information, -self.system.vector)
        return CellEquations(self.cells, system)

    def with_model_error(self, sigma_mm: float) -> CellEquations:
        """Inflate each cell's variance of a shift along the normals by sigma_mm^2."""
        return CellEquations(self.cells, self.system.inflate(sigma_mm**2, slice(3)))

    @staticmethod
    def sum(parts: Sequence[CellEquations]) -> CellEquations:
        """Add the equations of several overlaps."""
        cells = np.unique(np.concatenate([part.cells for part in parts]))
        information = np.zeros((len(cells), 12, 12))
        vector = np.zeros((len(cells), 12))
        for part in parts:
            at = np.searchsorted(cells, part.cells)
            information[at] += part.system.information
            vector[at] += part.system.vector
        return CellEquations(cells, LinearGaussianSystem(information, vector))


@compiled
def _accumulate(
    cell: Indices,
    surface: tuple[Array, Array],
    distances: Array,
    weights: Array,
    equations: tuple[Array, Array],
) -> None:
    """Add M distances to the lower triangles and gradients of their cells.

    surface: offsets (M, 3) from the cells' centres, and normals (M, 3).
    """
    offsets, normals = surface
    information, gradient = equations
    jacobian = np.empty(12)
    for n in range(len(distances)):
        for k in range(3):
            jacobian[k] = normals[n, k]
            for axis in range(3):
                jacobian[3 + 3 * axis + k] = offsets[n, axis] * normals[n, k]
        for i in range(12):
            weighted = weights[n] * jacobian[i]
            gradient[cell[n], i] += weighted * distances[n]
            for j in range(i + 1):
                information[cell[n], i, j] += weighted * jacobian[j]
