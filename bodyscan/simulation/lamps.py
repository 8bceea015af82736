"""How brightly the projector and the room light a surface."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from bodyscan.arrays import Floats
from bodyscan.simulation.gray import PAD
from bodyscan.simulation.projector import Projector
from bodyscan.simulation.scene import Hits, Scene, dot
from bodyscan.simulation.settings import Skin
from bodyscan.simulation.skin import came_in_at, highlight


@dataclass(frozen=True)
class Lamps:
    """Brightness of the light, and the distance of focus.

    laser_grey: grey level of a white surface that faces the projector at reach_mm.
    ambient_grey: grey level that the room's own light gives a white surface.
    focus_mm: distance at which the projector and the camera are focused.
    window_grey: grey level that a large window gives a white surface that faces it.
    window_way: (3,) unit, direction to the window, camera frame.
    skin: what skin does with light.
    """

    laser_grey: float
    ambient_grey: float
    reach_mm: float
    focus_mm: float
    window_grey: float = 0.0
    window_way: tuple[float, float, float] = (0.0, 0.0, -1.0)
    skin: Skin = field(default_factory=Skin)


def room_light(hits: Hits, lamps: Lamps) -> Floats:
    """Grey level (N,) of a white surface at each hit, due to the room's own light."""
    light = np.full(len(hits.depth), lamps.ambient_grey, np.float32)
    if lamps.window_grey <= 0:
        return light
    # The side that the camera sees; a window half the sky wide lights around the edge.
    towards = np.asarray(lamps.window_way, np.float32)
    length = np.sqrt(np.maximum(dot(hits.normals, hits.normals), np.float32(1e-12)))
    seen = -np.sign(dot(hits.normals, hits.points))
    cosine = seen * (hits.normals @ towards) / length
    facing = np.float32(0.5) * (np.float32(1.0) + cosine)
    facing = np.where(np.isfinite(hits.depth), facing, np.float32(0.0)).astype(np.float32)
    return np.asarray(light + np.float32(lamps.window_grey) * facing, np.float32)


@dataclass(frozen=True, eq=False)
class LaserLight:
    """What each hit (N,) would receive from a lit stripe.

    weight: grey level of the light that it scatters.
    s: stripe coordinate of the projector's light, NaN where none arrives.
    gloss: grey level of what its skin mirrors; None if nothing is glossy.
    """

    weight: Floats
    s: Floats
    gloss: Floats | None


def laser_light(
    scene: Scene, hits: Hits, projector: Projector, lamps: Lamps, *, seen: bool = True
) -> LaserLight:
    """Light by cosine, 1/r^2 and shadow.

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
    reaches = (front | (not seen)) & ~shadow
    weight = np.zeros(len(s), np.float32)
    weight[chosen] = bright * reaches * hits.albedo[chosen]

    covered = np.flatnonzero(hits.skin[chosen] > 0.5)
    gloss = None
    if covered.size and lamps.skin.gloss > 0:
        mirrored = highlight(points[covered], towards[covered], normals[covered], lamps.skin)
        full = np.float32(lamps.laser_grey * lamps.reach_mm**2) / square[covered]
        gloss = np.zeros(len(s), np.float32)
        gloss[chosen[covered]] = full * mirrored * reaches[covered]
    if covered.size and lamps.skin.oblique_mm > 0:
        aside = lamps.skin.oblique_mm
        entry = came_in_at(points[covered], towards[covered], normals[covered], aside)
        s = s.copy()
        s[chosen[covered]] = projector.stripe(entry)
    return LaserLight(weight, s, gloss)
