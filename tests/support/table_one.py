"""The camera of the chapter's Table 1, its calibration points and three ways to hold them."""

from __future__ import annotations

import numpy as np

from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses.opencv import Radial

# Table 1 of the chapter, and its 48 calibration points at 20 mm.
CAMERA = Camera(
    1061.71, 1064.09, -0.562002, 350.08, 286.547, Radial(-0.140279, -0.0916363), 640, 480
)
POINTS = np.array([[20.0 * c, 20.0 * r, 0.0] for r in range(1, 7) for c in range(1, 9)])
TURNS = ([0.4, 0.2, 0.05], [-0.35, 0.3, 0.0], [0.1, -0.45, 0.1])
