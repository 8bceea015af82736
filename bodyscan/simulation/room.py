"""The room: floor and walls, so that stripes fall on more than what is measured."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from bodyscan.simulation.layout import TruePair
from bodyscan.simulation.scene import Surface, grid_surface
from bodyscan.simulation.settings import Room


def build_room(pairs: Iterable[TruePair], room: Room) -> tuple[Surface, ...]:
    """Floor at z = 0 and four walls, in the rig frame."""
    places = np.stack([pair.rig_from_camera.translation for pair in pairs])
    half = max(room.wall_mm, 2.0 * float(np.linalg.norm(places[:, :2], axis=1).max()))
    x, y = np.array([2.0 * half, 0.0, 0.0]), np.array([0.0, 2.0 * half, 0.0])
    up, corner = np.array([0.0, 0.0, 3.0 * half]), np.array([-half, -half, 0.0])
    walls = [(corner, x, up), (corner, y, up), (corner + y, x, up), (corner + x, y, up)]
    floor = grid_surface(corner, x, y, albedo=room.floor, encloses=True)
    return (floor, *(grid_surface(*wall, albedo=room.wall, encloses=True) for wall in walls))
