"""How fast the body's cells moved while one pair saw them, as that pair's own stripes tell it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodyscan.alignment.body_cells import CELL_MM, BodyCells
from bodyscan.arrays import Array, Indices
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.geometry.velocity import SurfaceSpeeds


@dataclass(frozen=True, eq=False)
class CellSpeeds:
    """Normal equations of the speeds (mm/s, rig frame) with which cells are carried back: against
    the body's own.

    cells: (c,).  information (c, 3, 3), gradient (c, 3).  shared: (K, c, 3), information that errors
    which all cells share, of standard deviation 1, have in common with them; beside: (K, K) and (K,)
    that and what was seen of these errors.
    """

    cells: Indices
    information: Array
    gradient: Array
    shared: Array
    beside: tuple[Array, Array]

    @staticmethod
    def of(told: SurfaceSpeeds, rig_from_camera: RigidTransform, cells: BodyCells) -> CellSpeeds:
        """What a pair tells, each place in the cell that it lies in."""
        points, facing = rig_from_camera.apply(told.points), rig_from_camera.rotate(told.facing)
        normals = -facing / np.linalg.norm(facing, axis=1, keepdims=True)
        cell = cells.find(points, normals)
        near = np.linalg.norm(points - cells.centres[cell], axis=1) < CELL_MM
        own, number = np.unique(cell[near], return_inverse=True)
        weight, facing, speed = told.sigma[near] ** -2.0, facing[near], -told.speed[near]

        def total(values: Array) -> Array:
            """(c, ...) of values (n, ...)."""
            flat = values.reshape(len(values), -1).T
            sums = [np.bincount(number, column, len(own)).astype(float) for column in flat]
            return np.asarray(np.stack(sums, axis=-1).reshape(len(own), *values.shape[1:]))

        weighted, errors = weight[:, None] * facing, told.shared[near]
        return CellSpeeds(
            own,
            total(weighted[:, :, None] * facing[:, None, :]),
            total(weighted * speed[:, None]),
            np.moveaxis(total(errors[:, :, None] * weighted[:, None, :]), 1, 0),
            (np.eye(errors.shape[1]) + (errors.T * weight) @ errors, errors.T @ (weight * speed)),
        )

    def asked(self, fields: Array) -> tuple[Array, Array]:
        """(M, M) and (M,): normal equations of the rates at which fields (C, 12, M) grow."""
        own = fields[self.cells, :3]
        basis = own.reshape(-1, own.shape[2])
        shared = self.shared.reshape(len(self.shared), basis.shape[0]) @ basis
        square, pull = self.beside
        share = np.linalg.solve(square, shared)
        return (
            basis.T @ (self.information @ own).reshape(basis.shape) - shared.T @ share,
            basis.T @ self.gradient.ravel() - share.T @ pull,
        )
