"""A small pair whose light planes fan down from above, and what a surface decodes to in it."""

from __future__ import annotations

import numpy as np

from bodyscan.arrays import Array
from bodyscan.calibration.pair import PairCalibration, PairQuality
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses.opencv import Radial
from bodyscan.geometry.light_planes import LightPlanes
from bodyscan.stripes.stripe_map import StripeMap

CAMERA = Camera(400.0, 402.0, -0.5, 80.0, 60.0, Radial(-0.1, 0.02), 160, 120)
STRIPES = 64


def planes() -> LightPlanes:
    """Horizontal stripes from 200 mm above the camera, fanning down."""
    angle = np.radians(np.linspace(2.0, 40.0, STRIPES + 1))
    normals = np.stack([np.zeros_like(angle), np.cos(angle), np.sin(angle)], axis=1)
    normals[:, 2] *= -1.0
    coefficients = np.column_stack([normals, 200.0 * normals[:, 1]])
    return LightPlanes(coefficients, np.zeros((STRIPES + 1, 4, 4)), "horizontal")


def pair() -> PairCalibration:
    return PairCalibration("p", CAMERA, np.zeros((7, 7)), planes(), PairQuality(0.02, 3))


def stripe_map(depth: Array) -> StripeMap:
    """What a surface of known depth would decode to, found by bisection on the planes."""
    rays = CAMERA.pixel_rays()
    low, high = np.zeros_like(depth), np.full_like(depth, float(STRIPES))
    for _ in range(50):
        middle = 0.5 * (low + high)
        with np.errstate(invalid="ignore"):
            # The light comes down steeper with growing s: nearer along the ray.
            far = planes().intersect(rays, middle).depth > depth
        low, high = np.where(far, middle, low), np.where(far, high, middle)
    exact = 0.5 * (low + high)
    known = (exact > 0.5) & (exact < STRIPES - 0.5)
    s = np.where(known, exact, np.nan).astype(np.float32)
    sigma = np.where(known, 0.01, np.nan).astype(np.float32)
    nothing = np.empty(0, np.int64), np.empty((0, 2)), np.empty(0, np.float32)
    return StripeMap(s, sigma, np.full(s.shape, 150, np.uint8), *nothing, STRIPES)
