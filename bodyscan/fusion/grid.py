"""A camera for compiled functions."""

from __future__ import annotations

from bodyscan.arrays import Array
from bodyscan.geometry.camera import Camera


def lens_of(camera: Camera) -> Array:
    """(7,) for compiled functions: alpha, beta, gamma, u0, v0 (Eq. 1), k1, k2 (Eq. 3-5)."""
    return camera.parameters
