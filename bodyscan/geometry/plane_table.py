"""Smooth planes of light, tabulated over s: all of triangulation for millions of pixels at once.

The plane m(s).P = 1 (camera frame) meets the ray x with z = 1 at 1/z = m(s).x, so that depth, its
change with s and its variance follow from m, its derivative and its covariance, which are smooth in
s: linear between nodes an eighth of a stripe apart they are good to less than a micrometre.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from bodyscan.arrays import Array
from bodyscan.compiled import compiled
from bodyscan.geometry.bowed_sheets import PLANE_DEGREE, BowedSheets

NODES_PER_STRIPE = 8
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
    @lru_cache(maxsize=64)
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
        _measure(self._front(), self.rows, np.ascontiguousarray(rays), s, found)
        return found[0], found[1], found[2]

    def _front(self) -> Array:
        return np.append(self.forward, self.behind)


@compiled
def _measure(front: Array, rows: Array, rays: Array, s: Array, found: Array) -> None:
    """found (3, N): depth, dz/ds and variance of rays (N, 3) at s (N,).

    front: (4,) forward, behind.  rows: (K, 12).
    """
    last = len(rows) - 1
    for n in range(len(s)):
        found[0, n] = found[1, n] = found[2, n] = np.nan
        place = s[n] * NODES_PER_STRIPE
        if not (place >= 0.0 and place <= last):
            continue
        node, x, y = min(int(place), last - 1), rays[n, 0], rays[n, 1]
        share, low, high = place - node, _at(rows[node], x, y), _at(rows[node + 1], x, y)
        depth = 1.0 / (low[0] + share * (high[0] - low[0]))
        if not (depth > 0.0 and depth * (front[0] * x + front[1] * y + front[2]) > front[3]):
            continue
        square = depth * depth
        found[0, n] = depth
        found[1, n] = -square * (low[1] + share * (high[1] - low[1]))
        found[2, n] = square * square * (low[2] + share * (high[2] - low[2]))


@compiled
def _at(row: Array, x: float, y: float) -> tuple[float, float, float]:
    """1/z of the ray (x, y, 1) on the plane of one node, its derivative by s and its variance."""
    aside = row[6] * x * x + 2.0 * row[7] * x * y + row[9] * y * y
    return (
        row[0] * x + row[1] * y + row[2],
        row[3] * x + row[4] * y + row[5],
        aside + 2.0 * (row[8] * x + row[10] * y) + row[11],
    )
