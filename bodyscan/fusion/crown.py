"""How high a head may end, where cameras see its crown too flat to measure it.

A crown is convex: it lies below the tangent planes of all that was measured around it. Where what is
missing is small, or its rim nearly level, they hold it to a millimetre; where a head ends at its
hair they stand steep, and hold nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linprog

from bodyscan.arrays import Array, Floats

CELL_MM = 8.0
"""Over which points and normals are averaged: a crown bends by 0.1 mm over half of it, a fingertip's
radius is as long."""
AROUND_MM = 100.0
"""Half the length of a head: what lies farther aside of its highest point is no part of it."""
DOME_MM = 60.0
"""Below its highest point a head widens down to there; ears begin lower."""
UPWARD = 0.5
"""Least cosine to the vertical of planes that say how high a head goes."""
NOISE_MM = 0.5
"""A plane that something measured stands above by more is no bound: there the body is not convex."""


@dataclass(frozen=True, eq=False)
class Crown:
    """highest: (3,) mm, what was measured highest.  normals (P, 3), offsets (P,): of tangent planes
    below which all that was measured around lies."""

    highest: Array
    normals: Array
    offsets: Array

    @staticmethod
    def of(points: Array, normals: Array | Floats) -> Crown:
        """From points (N, 3), z up, and their normals (N, 3)."""
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
        """By how much the head may end higher than was measured; inf if nothing holds it."""
        if not len(self.offsets):
            return np.inf
        off = self.offsets - self.normals @ self.highest
        found = linprog([0.0, 0.0, -1.0], A_ub=self.normals, b_ub=off, bounds=(None, None))
        return max(0.0, float(found.x[2])) if found.x is not None else np.inf

    def outside(self, places: Array) -> Array:
        """(N,) mm by which places (N, 3) at the top of the head stand above its planes, at least 0."""
        near = places[:, 2] > self.highest[2] - DOME_MM / 3.0
        near &= np.hypot(*(places[:, :2] - self.highest[:2]).T) < AROUND_MM
        found = np.zeros(len(places))
        if len(self.offsets):
            found[near] = np.max(places[near] @ self.normals.T - self.offsets, axis=1)
        return np.maximum(found, 0.0)
