"""How high a head may end where cameras see its crown at too flat an angle to measure it.

A crown is convex, so it lies below the tangent planes of everything measured around it. If the gap is
small, or its rim nearly level, the planes bound it to a millimetre; where a head ends at its hairline
they are steep and bound nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodyscan.arrays import Array, Floats

CELL_MM = 8.0
"""Size of the cells over which points and normals are averaged: a crown bends by 0.1 mm over half of
one; a fingertip has that radius."""
AROUND_MM = 100.0
"""Half the length of a head: what lies farther from its highest point is not part of it."""
DOME_MM = 60.0
"""A head widens from its highest point down to here; ears begin lower."""
UPWARD = 0.5
"""Least cosine to the vertical of the planes that bound a head's height."""
NOISE_MM = 0.5
"""A plane that measured points exceed by more is no bound: the body is not convex there."""
REFINEMENTS, FINER = 10, 0.3
"""Grids, each 0.3 times as wide as the last: from 10 mm between nodes to a thousandth of one."""
GRID = np.stack(np.meshgrid(*[np.linspace(-1.0, 1.0, 21)] * 2), axis=-1).reshape(-1, 2)
"""Nodes (441, 2) of a grid of half width 1."""


@dataclass(frozen=True, eq=False)
class Crown:
    """Tangent planes below which everything measured around the top of a head lies.

    highest: the highest point measured, (3,) mm.
    normals, offsets: of the planes, (P, 3) and (P,) mm.
    """

    highest: Array
    normals: Array
    offsets: Array

    @staticmethod
    def from_cloud(points: Array, normals: Array | Floats) -> Crown:
        """The crown of a body's points (N, 3), z up, with normals (N, 3)."""
        highest = points[np.argmax(points[:, 2])]
        near = points[:, 2] > highest[2] - DOME_MM
        near &= np.hypot(*(points[:, :2] - highest[:2]).T) < AROUND_MM
        places, turned = points[near], normals[near].astype(np.float64)
        cell = np.floor(places / CELL_MM).astype(np.int64)
        _, number, count = np.unique(cell, axis=0, return_inverse=True, return_counts=True)

        def mean(values: Array) -> Array:
            sums = [np.bincount(number.ravel(), column) for column in values.T]
            return np.asarray(np.stack(sums, axis=1) / count[:, None])

        places, turned = mean(places), mean(turned)
        turned /= np.maximum(np.linalg.norm(turned, axis=1, keepdims=True), 1e-9)
        offsets = np.sum(places * turned, axis=1)
        above = np.max(turned @ places.T - offsets[:, None], axis=1, initial=0.0)
        holds = (above < NOISE_MM) & (turned[:, 2] > UPWARD)
        return Crown(highest, turned[holds], offsets[holds])

    @property
    def unknown_mm(self) -> float:
        """By how much the head may end higher than was measured; inf if nothing holds it.

        The planes' lower envelope is concave: ever finer grids around its best node find its top.
        """
        if not len(self.offsets):
            return np.inf
        slopes = self.normals[:, :2] / self.normals[:, 2:]
        above = (self.offsets - self.normals @ self.highest) / self.normals[:, 2]
        centre, half, top = np.zeros(2), AROUND_MM, 0.0
        for _ in range(REFINEMENTS):
            aside = centre + half * GRID
            heights = np.min(above - aside @ slopes.T, axis=1)
            centre, top = aside[np.argmax(heights)], float(heights.max())
            half *= FINER
        return max(0.0, top)

    def outside(self, places: Array) -> Array:
        """How far places (N, 3) at the top of the head lie above its planes, (N,) mm, at least 0."""
        near = places[:, 2] > self.highest[2] - DOME_MM / 3.0
        near &= np.hypot(*(places[:, :2] - self.highest[:2]).T) < AROUND_MM
        found = np.zeros(len(places))
        if len(self.offsets):
            found[near] = np.max(places[near] @ self.normals.T - self.offsets, axis=1)
        return np.maximum(found, 0.0)
