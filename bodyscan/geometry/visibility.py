"""Which points lie within a camera's image."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from bodyscan.arrays import Array, Mask
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.camera_tables import CAMERAS


def is_in_image(camera: Camera, points: Array, margin_px: float = 0.0) -> Mask:
    """Whether points (..., 3), camera frame, lie ahead of the camera and inside its image, (...).

    Far outside its image a lens model may fold back, so that points which the camera cannot see
    project inside. They are excluded by the lens's fold radius and by the rays of the image's own
    rim.
    """
    low, high = _reach(camera)
    ahead = points[..., 2] > 0.0
    safe = np.where(ahead[..., None], points, [0.0, 0.0, 1.0])
    ideal = safe[..., :2] / safe[..., 2:3]
    one_to_one = np.linalg.norm(ideal, axis=-1) < camera.lens.fold_radius
    pixels = camera.project(safe)
    last = np.array([camera.width - 1.0, camera.height - 1.0]) - margin_px
    inside = np.all((pixels >= margin_px) & (pixels <= last), axis=-1)
    return ahead & inside & one_to_one & np.all((ideal > low) & (ideal < high), axis=-1)


@lru_cache(CAMERAS)
def _reach(camera: Camera) -> tuple[Array, Array]:
    """Least and greatest ideal (x, y) within the image, with a small margin."""
    u, v = np.linspace(0.0, camera.width - 1.0, 9), np.linspace(0.0, camera.height - 1.0, 9)
    grid = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    rim = camera.rays(grid)[:, :2]
    return np.nanmin(rim, axis=0) - 0.01, np.nanmax(rim, axis=0) + 0.01
