"""How what a camera saw moved while it was seen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodyscan.arrays import Array


@dataclass(frozen=True, eq=False)
class SpeedField:
    """Speed along the viewing rays, in z, that no rigid motion explains, mm/s.

    columns (C,), rows (R,): px, places of the knots in the camera's image; linear between.
    speed, sigma: (R, C), of dz/dt at a fixed pixel; NaN where nothing was seen nearby.
    """

    columns: Array
    rows: Array
    speed: Array
    sigma: Array


@dataclass(frozen=True, eq=False)
class Velocity:
    """A rigid velocity in the camera's frame, about its centre, and what is not rigid of it.

    twist: (6,) rotation w, rad/s, and translation v, mm/s: a point p moves by w x p + v.
    covariance: (6, 6) of it. Surfaces do not show what moves them within themselves; such
    directions keep the width of the prior, that of people who stand.
    field: on top of the twist, where the evidence asks for it.
    """

    twist: Array
    covariance: Array
    field: SpeedField | None = None

    def at(self, points: Array) -> Array:
        """Of the rigid motion (..., 3), mm/s, at points (..., 3)."""
        return np.cross(self.twist[:3], points) + self.twist[3:]
