"""Rays through the centres of many pixels of one camera, its undistortion tabulated.

The ratio of ideal to real radius is smooth in the square of the real one: linear between nodes it
is good to 1e-4 px for lenses as wide as a radian, to 1e-6 px for a scanner's.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodyscan.arrays import Array, Mask
from bodyscan.compiled import compiled
from bodyscan.geometry.camera import Camera

NODES = 2048


@dataclass(frozen=True, eq=False)
class PixelRays:
    """lens: (5,) alpha, beta, gamma, u0, v0.  stretch: (K,) ideal over real radius where the square
    of the real normalized radius is 0, 1/per_square, 2/per_square, ... past the farthest corner.
    """

    lens: Array
    stretch: Array
    per_square: float

    @staticmethod
    def of(camera: Camera) -> PixelRays:
        u, v = np.meshgrid([0.0, camera.width - 1.0], [0.0, camera.height - 1.0])
        corners = camera.normalized_from_pixels(np.stack([u, v], axis=-1))
        per_square = (NODES - 2.0) / float(np.max(np.sum(corners**2, axis=-1)))
        radius = np.sqrt(np.arange(NODES) / per_square)
        ideal = camera.lens.undistort(np.stack([radius, np.zeros(NODES)], axis=-1))[:, 0]
        stretch = np.divide(ideal, radius, out=np.ones(NODES), where=radius > 0)
        lens = np.array([camera.alpha, camera.beta, camera.gamma, camera.u0, camera.v0])
        return PixelRays(lens, stretch, per_square)

    def through(self, wanted: Mask, first_row: int = 0) -> Array:
        """`Camera.rays` (N, 3) of the N pixels that are `wanted` (rows, width), row by row; the
        first row given is the image's `first_row`."""
        rays = np.empty((np.count_nonzero(wanted), 3))
        _rays(self.lens, self.stretch, self.per_square, first_row, wanted, rays)
        return rays


@compiled
def _rays(
    lens: Array, stretch: Array, per_square: float, first_row: int, wanted: Mask, rays: Array
) -> None:
    """rays (N, 3) of the N pixels `wanted` (rows, width); the others as in `PixelRays`."""
    alpha, beta, gamma, u0, v0 = lens
    n = 0
    for v in range(wanted.shape[0]):
        y = (first_row + v - v0) / beta
        for u in range(wanted.shape[1]):
            if wanted[v, u]:
                x = (u - u0 - gamma * y) / alpha
                place = (x * x + y * y) * per_square
                node = int(place)
                ideal = stretch[node] + (place - node) * (stretch[node + 1] - stretch[node])
                rays[n, 0], rays[n, 1], rays[n, 2] = x * ideal, y * ideal, 1.0
                n += 1
