"""A small camera, a mirror above it and walls before it, for the renderer."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from bodyscan.geometry.transforms import RigidTransform
from bodyscan.simulation.lamps import Lamps
from bodyscan.simulation.layout import build_mirror
from bodyscan.simulation.lens import TrueCamera
from bodyscan.simulation.projector import MirrorProjector
from bodyscan.simulation.rays import View
from bodyscan.simulation.scene import Surface, build_grid_surface
from bodyscan.simulation.settings import Optics, Projection

CAMERA = TrueCamera(190.0, 190.6, -0.1, 81.0, 62.5, -0.1, 0.05, 160, 128)
SHARP = Optics(blur_px=0.0)
CRISP = Projection(blur_stripes=0.0)
LAMPS = Lamps(laser_grey=200.0, ambient_grey=10.0, reach_mm=1000.0, focus_mm=1000.0)
STRIPES = 32


def projector(
    build: Callable[..., MirrorProjector] = build_mirror, projection: Projection = CRISP
) -> MirrorProjector:
    above = RigidTransform.from_rotation_vector([-0.25, 0.02, 0.01], [10.0, -280.0, 0.0])
    u, v = np.meshgrid(np.linspace(-0.5, 159.5, 7), np.linspace(-0.5, 127.5, 7))
    rays = CAMERA.directions(np.stack([u, v], axis=-1).reshape(-1, 2))
    seen = np.concatenate([rays * depth for depth in (700.0, 1000.0, 1600.0)])
    return build(above, STRIPES, True, seen, projection, np.random.default_rng(3))


def wall(z: float, size: float = 3000.0, **more: Any) -> Surface:
    corner = np.array([-size / 2, -size / 2, z])
    return build_grid_surface(corner, np.array([size, 0, 0]), np.array([0, size, 0]), **more)


def view(optics: Optics = SHARP) -> View:
    return View.from_camera(CAMERA, optics, np.random.default_rng(0))
