"""How fast a surface moved while a camera saw it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodyscan.arrays import Array


@dataclass(frozen=True, eq=False)
class SurfaceSpeeds:
    """Speeds at which places of a surface changed their depth, camera frame.

    points: (N, 3) mm.
    facing: (N, 3); a place that moves with velocity V changes its depth at a fixed pixel by facing
    . V.
    speed, sigma: (N,) mm/s, of that depth.
    shared: (N, K) mm/s, standard deviations of K errors that all places have in common.
    """

    points: Array
    facing: Array
    speed: Array
    sigma: Array
    shared: Array


@dataclass(frozen=True, eq=False)
class Velocity:
    """A rigid velocity in the camera's frame, about its centre, and the speeds it was fitted to.

    twist: (6,) rotation w, rad/s, and translation v, mm/s: a point p moves with w x p + v.
    covariance: (6, 6) of the twist. Motion of a surface within itself cannot be seen; such
    directions
        keep the width of the prior, that of people who stand.
    seen: the speeds behind it, including those of parts that do not move rigidly.
    """

    twist: Array
    covariance: Array
    seen: SurfaceSpeeds

    def at(self, points: Array) -> Array:
        """Velocity (..., 3), mm/s, of the rigid motion at points (..., 3)."""
        return np.cross(self.twist[:3], points) + self.twist[3:]
