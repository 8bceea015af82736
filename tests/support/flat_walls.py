"""A flat wall as a camera sees it, without noise."""

from __future__ import annotations

import numpy as np
from ball import range_image_of

from bodyscan.fusion.smoothing import SmoothSurface, smooth
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses.opencv import Radial
from bodyscan.geometry.transforms import RigidTransform

CAMERA = Camera(430.0, 428.0, 0.7, 81.0, 58.0, Radial(-0.12, 0.08), 160, 120)
WALL_MM = 320.0
ASIDE = RigidTransform(np.eye(3), np.array([40.0, 0.0, 0.0]))


def wall(depth: float, grey: int, placing: RigidTransform) -> SmoothSurface:
    """Seen square on, without noise; sigma 0.1 mm."""
    image = range_image_of(CAMERA, depth * CAMERA.pixel_rays(), grey=grey)
    surface = smooth(image, placing, 7.0)
    assert surface is not None
    return surface
