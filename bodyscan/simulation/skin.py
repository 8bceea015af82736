"""Skin as light sees it: light enters, spreads and leaves elsewhere, displaced if it came
obliquely."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from bodyscan.arrays import Array, Floats
from bodyscan.simulation.settings import Skin

Reals = NDArray[Any]

REFRACTION = 1.4
"""Refractive index of skin."""

_STEPS = 3
"""Scales (pixels per mm) between which the spread is interpolated, from near to far."""
_FINE = 9
"""Points per pixel, along each axis, at which the profile is summed: it is steep in the middle."""
_REACH = 18.0
"""Reach of a profile, in its shape parameter: a five-hundredth of the light lies beyond."""


def shape_mm(skin: Skin) -> float:
    """Burley's d, from the mean free path at the surface and its albedo (Christensen and Burley
    2015, Approximate Reflectance Profiles, Eq. 5)."""
    return skin.spread_mm / (1.9 - skin.albedo + 3.5 * (skin.albedo - 0.8) ** 2)


def spread_light(light: Floats, share: Floats, depth: Floats, alpha: float, skin: Skin) -> Floats:
    """Light (H, W) as it leaves: what enters skin comes out around there, and only from skin.

    share: (H, W) of each pixel that is skin.
    depth: (H, W) mm.
    alpha: focal length, px.
    """
    lit = share > 0
    if skin.spread_mm <= 0 or not lit.any():
        return light
    near, far = np.percentile(depth[lit], [2.0, 98.0])
    places = np.linspace(near, max(far, near + 1.0), _STEPS)
    place = np.clip((depth - near) / (places[1] - near), 0.0, _STEPS - 1.0)
    spread = np.zeros_like(light)
    for step, distance in enumerate(places):
        weight = np.maximum(1.0 - np.abs(place - step), 0.0).astype(np.float32)
        kernel = _kernel(round(shape_mm(skin) * alpha / float(distance), 3))
        out = cv2.filter2D(light * share, -1, kernel, borderType=cv2.BORDER_REFLECT_101)
        whole = cv2.filter2D(share, -1, kernel, borderType=cv2.BORDER_REFLECT_101)
        spread += weight * np.divide(out, whole, out=np.zeros_like(out), where=whole > 1e-6)
    enters = share * np.float32(1.0 - skin.stays)
    return light * (1.0 - enters) + spread * enters


@lru_cache(maxsize=64)
def _kernel(shape_px: float) -> Floats:
    """Burley's profile (exp(-r / d) + exp(-r / 3 d)) / (8 pi d r), (k, k), normalised to sum 1."""
    half = max(1, int(np.ceil(_REACH * shape_px)))
    size = 2 * half + 1
    fine = (np.arange(size * _FINE) + 0.5) / _FINE - size / 2.0
    r = np.hypot(*np.meshgrid(fine, fine))
    r = np.maximum(r, 0.25 / _FINE)  # the middle point is a cell, not a pole
    profile: Array = (np.exp(-r / shape_px) + np.exp(-r / (3.0 * shape_px))) / r
    kernel = profile.reshape(size, _FINE, size, _FINE).sum(axis=(1, 3))
    return np.asarray(kernel / kernel.sum(), np.float32)


def came_in_at(points: Reals, towards: Reals, normals: Reals, oblique_mm: float) -> Reals:
    """Where the light entered that leaves at points (N, 3): it continues under the surface, by
    `oblique_mm` times the tangent of the refracted angle.

    towards: (N, 3) to the source of the light.
    normals: (N, 3) of any length, to either side.
    """
    away = -towards / np.linalg.norm(towards, axis=1, keepdims=True)
    unit = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    along = away - np.sum(away * unit, axis=1, keepdims=True) * unit
    # Snell: the length of `along` is the sine of the angle of incidence.
    inside = along / REFRACTION
    tangent = inside / np.sqrt(1.0 - np.sum(inside**2, axis=1, keepdims=True))
    return np.asarray(points - oblique_mm * tangent, points.dtype)


def highlight(points: Reals, towards: Reals, normals: Reals, skin: Skin) -> Floats:
    """Brightness (N,) of the gloss at points, camera at the origin, relative to a white matt
    surface that faces the light (Blinn 1977)."""
    view = -points / np.linalg.norm(points, axis=1, keepdims=True)
    light = towards / np.linalg.norm(towards, axis=1, keepdims=True)
    half = view + light
    half = half / np.maximum(np.linalg.norm(half, axis=1, keepdims=True), 1e-12)
    unit = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    cosine = np.abs(np.sum(half * unit, axis=1))
    return np.asarray(skin.gloss * cosine**skin.gloss_power, np.float32)
