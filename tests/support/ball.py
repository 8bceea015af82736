"""Surfaces as a camera sees them."""

from __future__ import annotations

import numpy as np

from bodyscan.arrays import Array
from bodyscan.geometry.camera import Camera
from bodyscan.reconstruction.range_image import RangeImage


def ball_depth(camera: Camera, centre: Array, radius: float) -> Array:
    """(height, width) z of its front, mm, camera frame; NaN beside it."""
    rays = camera.pixel_rays()
    square, along = np.sum(rays**2, axis=-1), rays @ centre
    root = along**2 - square * (centre @ centre - radius**2)
    return np.asarray((along - np.sqrt(np.where(root > 0.0, root, np.nan))) / square)


def ball_points(camera: Camera, centre: Array, radius: float) -> Array:
    """(height, width, 3) of its front, mm, camera frame; NaN beside it."""
    return camera.pixel_rays() * ball_depth(camera, centre, radius)[..., None]


def range_image_of(
    camera: Camera,
    points: Array,
    normals: Array | None = None,
    *,
    sigma_mm: float = 0.1,
    pair: str = "p",
    grey: int = 0,
) -> RangeImage:
    """Points (height, width, 3), camera frame, NaN where nothing is; they stand for missing normals."""
    at = points.astype(np.float32)
    sigma = np.where(np.isfinite(at[..., 2]), np.float32(sigma_mm), np.float32(np.nan))
    towards = at if normals is None else normals.astype(np.float32)
    return RangeImage(pair, camera, at, towards, sigma, np.full(sigma.shape, grey, np.uint8))
