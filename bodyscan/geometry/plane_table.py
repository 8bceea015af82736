"""Smooth planes of light, tabulated over s: all of triangulation for millions of pixels at once.

The plane m(s).P = 1 (camera frame) meets the ray x with z = 1 at 1/z = m(s).x, so that depth, its
change with s and its variance follow from m, its derivative and its covariance, which are smooth in
s: linear between nodes an eighth of a stripe apart they are good to less than a micrometre.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bodyscan.geometry.bowed_sheets import PLANE_DEGREE, BowedSheets

Array = NDArray[np.float64]

NODES_PER_STRIPE = 8
CHUNK = 1 << 14  # pixels at a time: what fits into a processor's cache
UPPER = tuple(np.triu_indices(3))


@dataclass(frozen=True, eq=False)
class PlaneTable:
    """rows: (K, 12) at s = 0, 1/8, 2/8, ...: m (1/mm), dm/ds, and the upper triangle of m's
    covariance, row by row.  forward (3,), behind: a point x z of a ray lies in front of the
    projector where z (forward.x) > behind.
    """

    rows: Array
    stripes: int
    forward: Array
    behind: float

    @staticmethod
    def of(sheets: BowedSheets) -> PlaneTable:
        """Of sheets without a bow: y' = p + q x' + r w is q X - Y + (p - r) Z + r D = 0."""
        turn, shift = (
            sheets.projector_from_camera.rotation,
            sheets.projector_from_camera.translation,
        )
        at = sheets.at(np.arange(NODES_PER_STRIPE * sheets.stripes + 1.0) / NODES_PER_STRIPE)
        p, q, r = at.value.T
        normal = np.stack([q, -np.ones_like(p), p - r], axis=-1)
        offset = normal @ shift + r * sheets.distance_mm
        m = -(normal @ turn) / offset[:, None]
        # Derivatives of normal (3) and offset by (p, q, r), then of m = -normal/offset.
        by = np.array([[0.0, 1, 0], [0, 0, 0], [1, 0, -1]])
        offset_by = shift @ by + np.array([0.0, 0, sheets.distance_mm])
        m_by = -(turn.T @ by) - m[:, :, None] * offset_by
        m_by /= offset[:, None, None]
        size = PLANE_DEGREE + 1
        blocks = sheets.covariance.reshape(3, size, 3, size)
        spread = np.einsum("km,imjn,kn->kij", at.basis, blocks, at.basis, optimize=True)
        covariance = m_by @ spread @ m_by.transpose(0, 2, 1)
        slope = np.einsum("kij,kj->ki", m_by, at.slope)
        rows = np.concatenate([m, slope, covariance[:, UPPER[0], UPPER[1]]], axis=1)
        return PlaneTable(rows, sheets.stripes, turn[2], -float(shift[2]))

    def measure(self, rays: Array, s: Array) -> tuple[Array, Array, Array]:
        """Depth z (N,) mm, dz/ds and the variance of z, for rays (N, 3) at s (N,); NaN where none."""
        found = np.empty((3, len(s)))
        for start in range(0, len(s), CHUNK):
            part = slice(start, start + CHUNK)
            found[:, part] = self._measure(rays[part], s[part])
        return found[0], found[1], found[2]

    def _measure(self, rays: Array, s: Array) -> Array:
        place = np.clip(np.nan_to_num(s), 0.0, self.stripes) * NODES_PER_STRIPE
        node = np.minimum(place.astype(np.intp), len(self.rows) - 2)
        low = self.rows[node]
        row = (low + (place - node)[:, None] * (self.rows[node + 1] - low)).T
        x, y, _ = rays.T
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = 1.0 / (row[0] * x + row[1] * y + row[2])
            change = row[3] * x + row[4] * y + row[5]
            xx, xy, xz, yy, yz, zz = row[6:]
            spread = xx * x * x + yy * y * y + zz + 2.0 * (xy * x * y + xz * x + yz * y)
            good = (depth > 0.0) & (depth * (rays @ self.forward) > self.behind)
            good &= (s >= 0.0) & (s <= self.stripes)
            square = depth * depth
            found = np.stack([depth, -square * change, square * square * spread])
            return np.where(good, found, np.nan)
