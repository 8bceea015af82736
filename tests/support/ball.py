"""A ball as a camera sees it."""

from __future__ import annotations

import numpy as np

from bodyscan.arrays import Array
from bodyscan.geometry.camera import Camera


def ball_depth(camera: Camera, centre: Array, radius: float) -> Array:
    """(height, width) z of its front, mm, camera frame; NaN beside it."""
    rays = camera.pixel_rays()
    square, along = np.sum(rays**2, axis=-1), rays @ centre
    root = along**2 - square * (centre @ centre - radius**2)
    return np.asarray((along - np.sqrt(np.where(root > 0.0, root, np.nan))) / square)


def ball_points(camera: Camera, centre: Array, radius: float) -> Array:
    """(height, width, 3) of its front, mm, camera frame; NaN beside it."""
    return camera.pixel_rays() * ball_depth(camera, centre, radius)[..., None]
