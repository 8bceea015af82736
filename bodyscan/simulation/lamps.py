"""Light on surfaces: the projector's, the room's, and what skin does with it."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from bodyscan.arrays import Array, Floats
from bodyscan.simulation.patterns import PAD
from bodyscan.simulation.projector import Projector
from bodyscan.simulation.scene import Hits, Scene, dot
from bodyscan.simulation.settings import Skin


@dataclass(frozen=True)
class Lamps:
    """Brightness of the light, and the distance of focus."""

    laser_grey: float  # grey level of a white surface that faces the projector at reach_mm
    ambient_grey: float  # grey level that the room's own light gives a white surface
    reach_mm: float
    focus_mm: float  # distance at which the projector and the camera are focused
    window_grey: float = 0.0  # grey level that a large window gives a white surface that faces it
    # (3,) unit, direction to the window, camera frame.
    window_direction: tuple[float, float, float] = (0.0, 0.0, -1.0)
    skin: Skin = field(default_factory=Skin)  # what skin does with light


def compute_room_light(hits: Hits, lamps: Lamps) -> Floats:
    """Compute the grey level (N,) of a white surface at each hit under the room's own light."""
    light = np.full(len(hits.depth), lamps.ambient_grey, np.float32)
    if lamps.window_grey <= 0:
        return light
    # The side that the camera sees; a window half the sky wide lights around the edge.
    towards = np.asarray(lamps.window_direction, np.float32)
    length = np.sqrt(np.maximum(dot(hits.normals, hits.normals), np.float32(1e-12)))
    side = -np.sign(dot(hits.normals, hits.points))
    cosine = side * (hits.normals @ towards) / length
    facing = np.float32(0.5) * (np.float32(1.0) + cosine)
    facing = np.where(np.isfinite(hits.depth), facing, np.float32(0.0)).astype(np.float32)
    return np.asarray(light + np.float32(lamps.window_grey) * facing, np.float32)


@dataclass(frozen=True, eq=False)
class LaserLight:
    """What each hit (N,) would receive from a lit stripe."""

    weight: Floats  # grey level of the light that it scatters
    s: Floats  # stripe coordinate of the projector's light, NaN where none arrives
    gloss: Floats  # grey level of what its skin mirrors


def compute_laser_light(scene: Scene, hits: Hits, projector: Projector, lamps: Lamps) -> LaserLight:
    """Light the hits by cosine, 1/r^2 and shadow, on the side that the camera sees."""
    s = projector.stripe(hits.points)
    reached = np.isfinite(hits.depth) & (s > -PAD) & (s < projector.stripes + PAD)
    chosen = np.flatnonzero(reached)
    points, normals = hits.points.take(chosen, axis=0), hits.normals.take(chosen, axis=0)
    towards = projector.source(s[chosen]) - points
    square, height = dot(towards, towards), dot(towards, normals)
    front = height * dot(points, normals) < 0  # light and viewer are on the same side
    cosine = np.abs(height) / np.sqrt(square * dot(normals, normals))
    shadow = scene.is_shadowed(points, towards, hits.surface[chosen])
    bright = np.float32(lamps.laser_grey * lamps.reach_mm**2) * cosine / square
    reaches = front & ~shadow
    weight = np.zeros(len(s), np.float32)
    weight[chosen] = bright * reaches * hits.albedo[chosen]

    covered, gloss = np.flatnonzero(hits.skin[chosen] > 0.5), np.zeros(len(s), np.float32)
    if covered.size and lamps.skin.gloss > 0:
        mirrored = compute_highlight(
            points[covered], towards[covered], normals[covered], lamps.skin
        )
        full = np.float32(lamps.laser_grey * lamps.reach_mm**2) / square[covered]
        gloss[chosen[covered]] = full * mirrored * reaches[covered]
    return LaserLight(weight, s, gloss)


Reals = NDArray[Any]


def shape_mm(skin: Skin) -> float:
    """Compute Burley's d from mean free path and albedo (Christensen and Burley 2015, Eq. 5)."""
    return skin.spread_mm / (1.9 - skin.albedo + 3.5 * (skin.albedo - 0.8) ** 2)


def spread_light(light: Floats, share: Floats, depth: Floats, alpha: float, skin: Skin) -> Floats:
    """Diffuse light (H, W) below the skin: what enters comes out nearby, and only from skin.

    share: (H, W) of each pixel that is skin.
    depth: (H, W) mm.
    alpha: focal length, px.
    """
    lit = share > 0
    if skin.spread_mm <= 0 or not lit.any():
        return light
    near, far = np.percentile(depth[lit], [2.0, 98.0])
    distances = np.linspace(near, max(far, near + 1.0), 3)
    level = np.clip((depth - near) / (distances[1] - near), 0.0, 2.0)
    outgoing = np.zeros_like(light)
    for step, distance in enumerate(distances):
        weight = np.maximum(1.0 - np.abs(level - step), 0.0).astype(np.float32)
        kernel = _make_profile_kernel(round(shape_mm(skin) * alpha / float(distance), 3))
        out = cv2.filter2D(light * share, -1, kernel, borderType=cv2.BORDER_REFLECT_101)
        whole = cv2.filter2D(share, -1, kernel, borderType=cv2.BORDER_REFLECT_101)
        outgoing += weight * np.divide(out, whole, out=np.zeros_like(out), where=whole > 1e-6)
    enters = share * np.float32(1.0 - skin.stays)
    return light * (1.0 - enters) + outgoing * enters


@lru_cache(maxsize=64)
def _make_profile_kernel(shape_px: float) -> Floats:
    """Sample Burley's profile (exp(-r / d) + exp(-r / 3 d)) / (8 pi d r) on (k, k), sum 1."""
    half = max(1, int(np.ceil(18.0 * shape_px)))  # 1/500 of the light lies beyond
    size, fine_steps = 2 * half + 1, 9  # the profile is steep in the middle
    fine = (np.arange(size * fine_steps) + 0.5) / fine_steps - size / 2.0
    r = np.hypot(*np.meshgrid(fine, fine))
    r = np.maximum(r, 0.25 / fine_steps)  # the middle point is a cell, not a pole
    profile: Array = (np.exp(-r / shape_px) + np.exp(-r / (3.0 * shape_px))) / r
    kernel = profile.reshape(size, fine_steps, size, fine_steps).sum(axis=(1, 3))
    return np.asarray(kernel / kernel.sum(), np.float32)


def compute_highlight(points: Reals, towards: Reals, normals: Reals, skin: Skin) -> Floats:
    """Compute gloss (N,) for a camera at the origin, relative to a white matt surface (Blinn 1977)."""
    view = -points / np.linalg.norm(points, axis=1, keepdims=True)
    light = towards / np.linalg.norm(towards, axis=1, keepdims=True)
    half = view + light
    half = half / np.maximum(np.linalg.norm(half, axis=1, keepdims=True), 1e-12)
    unit = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    cosine = np.abs(np.sum(half * unit, axis=1))
    return np.asarray(skin.gloss * cosine**skin.gloss_power, np.float32)
