"""A flat wall as a camera sees it, without noise."""

from __future__ import annotations

import numpy as np

from bodyscan.fusion.smoothing import SmoothSurface, smooth
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses.opencv import Radial
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.reconstruction.range_image import RangeImage

CAMERA = Camera(430.0, 428.0, 0.7, 81.0, 58.0, Radial(-0.12, 0.08), 160, 120)
WALL_MM = 320.0
ASIDE = RigidTransform(np.eye(3), np.array([40.0, 0.0, 0.0]))


def wall(depth: float, grey: int, placing: RigidTransform) -> SmoothSurface:
    """Seen square on, without noise; sigma 0.1 mm."""
    points = (depth * CAMERA.pixel_rays()).astype(np.float32)
    sigma = np.full(points.shape[:2], 0.1, np.float32)
    colours = np.full(points.shape[:2], grey, np.uint8)
    surface = smooth(RangeImage("pair", CAMERA, points, points, sigma, colours), placing, 7.0)
    assert surface is not None
    return surface
