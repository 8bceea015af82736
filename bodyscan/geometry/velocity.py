"""How what a camera saw moved while it was seen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodyscan.arrays import Array


@dataclass(frozen=True, eq=False)
class SurfaceSpeeds:
    """How fast places of a surface changed their depth, camera frame.

    points: (N, 3) mm.  facing: (N, 3): a place that moves by V changes its depth at a fixed pixel by
    facing . V.  speed, sigma: (N,) of that depth, mm/s.  shared: (N, K) mm/s, standard deviations of
    what all of them are off by together, K such errors.
    """

    points: Array
    facing: Array
    speed: Array
    sigma: Array
    shared: Array


@dataclass(frozen=True, eq=False)
class Velocity:
    """A rigid velocity in the camera's frame, about its centre, and what was seen of it.

    twist: (6,) rotation w, rad/s, and translation v, mm/s: a point p moves by w x p + v.
    covariance: (6, 6) of it. Surfaces do not show what moves them within themselves; such
    directions keep the width of the prior, that of people who stand.
    seen: the speeds behind it, of what does not move as one too.
    """

    twist: Array
    covariance: Array
    seen: SurfaceSpeeds

    def at(self, points: Array) -> Array:
        """Of the rigid motion (..., 3), mm/s, at points (..., 3)."""
        return np.cross(self.twist[:3], points) + self.twist[3:]
