"""How bright the projector makes a surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodyscan.arrays import Floats
from bodyscan.simulation.gray import PAD
from bodyscan.simulation.projector import Projector
from bodyscan.simulation.scene import Hits, Scene, dot


@dataclass(frozen=True)
class Lamps:
    """How bright, and where it is sharp.

    laser_grey: grey level of a white surface that faces the projector at reach_mm.
    ambient_grey: what the room's own light makes of a white surface.
    focus_mm: distance at which the projector and the camera are focused.
    window_grey: what a large window makes of a white surface that faces it.  window_way: (3,) unit,
    where it is, camera frame.
    """

    laser_grey: float
    ambient_grey: float
    reach_mm: float
    focus_mm: float
    window_grey: float = 0.0
    window_way: tuple[float, float, float] = (0.0, 0.0, -1.0)


def room_light(hits: Hits, lamps: Lamps) -> Floats:
    """(N,) grey level that a white surface would get of the room's own light at each hit."""
    light = np.full(len(hits.depth), lamps.ambient_grey, np.float32)
    if lamps.window_grey <= 0:
        return light
    # The side that the camera sees; of a window half the sky wide, light comes round the side.
    towards = np.asarray(lamps.window_way, np.float32)
    length = np.sqrt(np.maximum(dot(hits.normals, hits.normals), np.float32(1e-12)))
    seen = -np.sign(dot(hits.normals, hits.points))
    cosine = seen * (hits.normals @ towards) / length
    facing = np.float32(0.5) * (np.float32(1.0) + cosine)
    facing = np.where(np.isfinite(hits.depth), facing, np.float32(0.0)).astype(np.float32)
    return np.asarray(light + np.float32(lamps.window_grey) * facing, np.float32)


def laser_light(
    scene: Scene, hits: Hits, projector: Projector, lamps: Lamps, *, seen: bool = True
) -> tuple[Floats, Floats]:
    """Grey level that each hit would get from a lit stripe (cosine, 1/r^2, shadow), and its s.

    seen: only where the light falls on the side that the camera sees.
    """
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
    weight = np.zeros(len(s), np.float32)
    weight[chosen] = bright * ((front | (not seen)) & ~shadow) * hits.albedo[chosen]
    return weight, s
