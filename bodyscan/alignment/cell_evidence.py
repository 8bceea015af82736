"""What the overlap of two pairs asks of the body's cells: normal equations of affine motions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bodyscan.alignment.matching import Matches
from bodyscan.alignment.overlap_equations import match_weights
from bodyscan.arrays import Array, Indices
from bodyscan.compiled import compiled


@dataclass(frozen=True, eq=False)
class CellEvidence:
    """Normal equations of an overlap, cell by cell.

    With d the distances from the second pair's surface to the first's, and J their Jacobian by the
    first's displacement field in a cell (see `rigid_fields`).

    cells: those in which the pairs overlap, (c,).
    information: J^T W J, (c, 12, 12).
    gradient: J^T W d, (c, 12).
    """

    cells: Indices
    information: Array
    gradient: Array

    @staticmethod
    def of(matches: Matches, cell: Indices, centres: Array, correlated: float) -> CellEvidence:
        """Gather matches by cell; cell: (M,) of each match. Weights as in `OverlapEquations`."""
        seen = np.bincount(cell, minlength=len(centres)) > 0
        cells, number = np.flatnonzero(seen), (np.cumsum(seen) - 1)[cell]
        information = np.zeros((len(cells), 12, 12))
        gradient = np.zeros((len(cells), 12))
        distances = matches.distances
        _accumulate(
            number,
            (matches.points - centres[cell], matches.normals),
            distances,
            match_weights(matches),
            (information, gradient),
        )
        information += np.swapaxes(np.tril(information, -1), 1, 2)
        return CellEvidence(cells, information / correlated, gradient / correlated)

    def turned(self) -> CellEvidence:
        """The same with first and second exchanged."""
        return CellEvidence(self.cells, self.information, -self.gradient)

    def doubted(self, misfit_mm: float) -> CellEvidence:
        """The same with less weight, for a misfit per cell that no motion of the body explains."""
        share = 1.0 / (1.0 + misfit_mm**2 * self._weight)
        return CellEvidence(
            self.cells, self.information * share[:, None, None], self.gradient * share[:, None]
        )

    @property
    def _weight(self) -> Array:
        """Inverse variance of a shift along the surface's normals, (c,)."""
        return np.asarray(np.trace(self.information[:, :3, :3], axis1=1, axis2=2))

    @staticmethod
    def total(parts: Sequence[CellEvidence]) -> CellEvidence:
        cells = np.unique(np.concatenate([part.cells for part in parts]))
        information = np.zeros((len(cells), 12, 12))
        gradient = np.zeros((len(cells), 12))
        for part in parts:
            at = np.searchsorted(cells, part.cells)
            information[at] += part.information
            gradient[at] += part.gradient
        return CellEvidence(cells, information, gradient)


@compiled
def _accumulate(
    cell: Indices,
    places: tuple[Array, Array],
    distances: Array,
    weights: Array,
    equations: tuple[Array, Array],
) -> None:
    """Add M distances to the lower triangles and gradients of their cells.

    places: offsets (M, 3) from the cell's centre, and normals (M, 3).
    """
    off, normals = places
    information, gradient = equations
    jacobian = np.empty(12)
    for n in range(len(distances)):
        for k in range(3):
            jacobian[k] = normals[n, k]
            for axis in range(3):
                jacobian[3 + 3 * axis + k] = off[n, axis] * normals[n, k]
        for i in range(12):
            weighted = weights[n] * jacobian[i]
            gradient[cell[n], i] += weighted * distances[n]
            for j in range(i + 1):
                information[cell[n], i, j] += weighted * jacobian[j]
