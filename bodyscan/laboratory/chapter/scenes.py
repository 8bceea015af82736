"""What stands before the chapter's camera, and the images that it takes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import open3d as o3d

from bodyscan.arrays import Bytes
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.laboratory.chapter import apparatus
from bodyscan.laboratory.chapter.apparatus import ChapterSetup
from bodyscan.rig.frame_names import FrameNames
from bodyscan.simulation.lamps import Lamps
from bodyscan.simulation.render import render_pair
from bodyscan.simulation.scene import Scene, Surface, grid_surface
from bodyscan.simulation.sensor import expose
from bodyscan.stripes.decoding import decode_stripes
from bodyscan.stripes.stripe_map import StripeMap

SPHERE_RINGS = 400
"""Facets of a sphere are then less than 0.0005 mm inside it."""
LAMP_GREY, AMBIENT_GREY = 255.0, 13.0
WHITE, GROUND, WALL = 0.8, 0.5, 0.3


@dataclass(frozen=True, eq=False)
class Exposure:
    """What the camera took: the lit image, and the stripes decoded from the whole sequence."""

    lit: Bytes
    stripes: StripeMap


def board_scene(setup: ChapterSetup, camera_from_board: RigidTransform) -> list[Surface]:
    """The board, and a wall behind it."""
    return [*(surface.moved(camera_from_board) for surface in setup.board.surfaces), _wall()]


def sphere_scene() -> list[Surface]:
    """Five white spheres on the ground, and a wall behind."""
    mesh = o3d.geometry.TriangleMesh.create_sphere(apparatus.RADIUS_MM, resolution=SPHERE_RINGS)
    arms = np.asarray(mesh.vertices)
    ball = Surface(arms, np.asarray(mesh.triangles), WHITE, normals=arms / apparatus.RADIUS_MM)
    spheres = [replace(ball, vertices=arms + centre) for centre in apparatus.CENTRES]
    return [*spheres, _ground(), _wall()]


def plate_scene() -> list[Surface]:
    """A flat white plate, somewhat smaller than the board: no calibration reaches farther."""
    place = apparatus.place_about(apparatus.PLATE_MIDDLE, apparatus.PLATE_TURN, middle=np.zeros(3))
    width, height = apparatus.PLATE_MM
    across, down = np.array([width, 0.0, 0.0]), np.array([0.0, height, 0.0])
    plate = grid_surface(-0.5 * (across + down), across, down, albedo=WHITE)
    return [replace(plate, open_to_light=True).moved(place), _wall()]


def expose_scene(
    setup: ChapterSetup, surfaces: Sequence[Surface], number: int, times: int = 1
) -> list[Exposure]:
    """Render the sequence and decode its stripes; `number` selects the shot's noise.

    times: how often the sensor's noise is drawn anew on the same light (jitter and speckle too).
    """
    rng = np.random.default_rng([setup.seed, apparatus.NOISE, number])
    settings = setup.settings
    lamps = Lamps(LAMP_GREY, AMBIENT_GREY, apparatus.DISTANCE_MM * 1.05, apparatus.DISTANCE_MM)
    images = render_pair(
        Scene(surfaces), setup.view, setup.projector, lamps, settings.projection, rng
    )
    return [
        _read({name: expose(image, settings.noise, rng) for name, image in images.items()})
        for _ in range(times)
    ]


def _read(frames: dict[str, Bytes]) -> Exposure:
    code = apparatus.PROJECTOR
    coded = np.stack([frames[name] for name in FrameNames().of_code(code)])
    stripes = decode_stripes(code, frames["lit"], frames["dark"], coded)
    return Exposure(frames["lit"], stripes)


def _ground() -> Surface:
    """The plane on which all five spheres lie."""
    across, down = np.array([1.0, 0.0, 0.0]), apparatus.CENTRES[3] - apparatus.CENTRES[0]
    down = (down - (down @ across) * across) / np.linalg.norm(down[1:])
    below = apparatus.CENTRES[1] + apparatus.RADIUS_MM * np.cross(across, down)
    return grid_surface(
        below - 300.0 * (across + down), 600.0 * across, 600.0 * down, albedo=GROUND
    )


def _wall() -> Surface:
    corner = np.array([-1500.0, -1500.0, 2.0 * apparatus.DISTANCE_MM])
    across, down = np.array([3000.0, 0.0, 0.0]), np.array([0.0, 3000.0, 0.0])
    return grid_surface(corner, across, down, albedo=WALL, encloses=True)
