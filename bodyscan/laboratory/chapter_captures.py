"""The chapter's scenes, and the images that its simulated camera takes of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import open3d as o3d

from bodyscan.arrays import Array, Bytes, Indices, Mask
from bodyscan.boards.detection import find_boards
from bodyscan.errors import BoardNotFound
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.laboratory import apparatus
from bodyscan.laboratory.apparatus import ChapterSetup
from bodyscan.laboratory.approaches import StripedShot
from bodyscan.progress import Progress, silent
from bodyscan.rig.frame_names import FrameNames
from bodyscan.simulation.lamps import Lamps
from bodyscan.simulation.render import PixelTruth, compute_pixel_truth, render_pair
from bodyscan.simulation.scene import Scene, Surface, grid_surface
from bodyscan.simulation.sensor import expose
from bodyscan.stripes.decoding import decode_stripes
from bodyscan.stripes.stripe_map import StripeMap


def board_scene(setup: ChapterSetup, camera_from_board: RigidTransform) -> list[Surface]:
    """Build the board, and a wall behind it."""
    return [*(surface.transform(camera_from_board) for surface in setup.board.surfaces), _wall()]


def sphere_scene() -> list[Surface]:
    """Build five white spheres on the ground, and a wall behind."""
    mesh = o3d.geometry.TriangleMesh.create_sphere(apparatus.RADIUS_MM, resolution=400)
    arms = np.asarray(mesh.vertices)
    ball = Surface(arms, np.asarray(mesh.triangles), 0.8, normals=arms / apparatus.RADIUS_MM)
    spheres = [replace(ball, vertices=arms + centre) for centre in apparatus.CENTRES]
    return [*spheres, _ground(), _wall()]


def plate_scene() -> list[Surface]:
    """Build a flat white plate, smaller than the board: no calibration reaches farther."""
    pose = apparatus.pose_about((-11.0, -17.0, 402.0), (0.15, 0.1, 0.0), middle=np.zeros(3))
    width, height = 160.0, 120.0
    across, down = np.array([width, 0.0, 0.0]), np.array([0.0, height, 0.0])
    plate = grid_surface(-0.5 * (across + down), across, down, albedo=0.8)
    return [replace(plate, open_to_light=True).transform(pose), _wall()]


def expose_scene(
    setup: ChapterSetup, surfaces: Sequence[Surface], number: int
) -> tuple[Bytes, StripeMap]:
    """Render the sequence; return the lit image and the decoded stripes.

    number: selects the shot's noise.
    """
    rng = np.random.default_rng([setup.seed, apparatus.Stream.NOISE, number])
    settings = setup.settings
    lamps = Lamps(255.0, 13.0, apparatus.DISTANCE_MM * 1.05, apparatus.DISTANCE_MM)
    images = render_pair(
        Scene(surfaces), setup.view, setup.projector, lamps, settings.projection, rng
    )
    frames = {name: expose(image, settings.noise, rng) for name, image in images.items()}
    code = apparatus.PROJECTOR
    coded = np.stack([frames[name] for name in FrameNames().code_names(code)])
    return frames["lit"], decode_stripes(code, frames["lit"], frames["dark"], coded)


def _ground() -> Surface:
    """Build the plane on which all five spheres lie."""
    across, down = np.array([1.0, 0.0, 0.0]), apparatus.CENTRES[3] - apparatus.CENTRES[0]
    down = (down - (down @ across) * across) / np.linalg.norm(down[1:])
    below = apparatus.CENTRES[1] + apparatus.RADIUS_MM * np.cross(across, down)
    return grid_surface(below - 300.0 * (across + down), 600.0 * across, 600.0 * down, albedo=0.5)


def _wall() -> Surface:
    corner = np.array([-1500.0, -1500.0, 2.0 * apparatus.DISTANCE_MM])
    across, down = np.array([3000.0, 0.0, 0.0]), np.array([0.0, 3000.0, 0.0])
    return grid_surface(corner, across, down, albedo=0.3, encloses=True)


@dataclass(frozen=True, eq=False)
class SceneCapture:
    """One scene: its stripes, and the truth."""

    stripes: StripeMap
    truth: PixelTruth


@dataclass(frozen=True, eq=False)
class ChapterCaptures:
    """All captures.

    boards: the three poses, or as many as were asked for.
    stage, readings: a board on a slide stage, and its readings (mm).
    owner: (H, W) number of the sphere that a pixel's centre sees and the projector lights, or -1.
    on_plate: (H, W) pixels on the plate, clear of its rim.
    """

    setup: ChapterSetup
    boards: tuple[StripedShot, ...]
    stage: tuple[StripedShot, ...]
    readings: Array
    spheres: SceneCapture
    plate: SceneCapture
    owner: Indices
    on_plate: Mask


def take_captures(
    setup: ChapterSetup,
    *,
    boards: int = apparatus.BOARDS,
    stage_stops: int = 7,
    progress: Progress = silent,
) -> ChapterCaptures:
    """Render, expose and decode everything. Raises BoardNotFound if a board is not found."""
    readings = apparatus.stage_readings(stage_stops)
    poses, stage = apparatus.board_poses(boards), apparatus.stage_poses(readings, setup.seed)
    total = boards + len(stage) + 2
    progress("rendering", 0, total)
    shots = []
    for number, pose in enumerate([*poses, *stage]):
        of_stage = number - boards
        stream = 100 + of_stage if of_stage >= 0 else number
        name = f"stage{of_stage + 1}" if of_stage >= 0 else f"board{number + 1}"
        shots.append(_board_shot(setup, pose, name, stream))
        progress("rendering", number + 1, total)
    spheres = _expose(setup, sphere_scene(), 200)
    progress("rendering", total - 1, total)
    plate = _expose(setup, plate_scene(), 300)
    progress("rendering", total, total)
    return ChapterCaptures(
        setup,
        tuple(shots[:boards]),
        tuple(shots[boards:]),
        readings,
        spheres,
        plate,
        _label_spheres(setup, spheres.truth),
        _mask_plate(plate.truth),
    )


def _board_shot(setup: ChapterSetup, pose: RigidTransform, shot: str, number: int) -> StripedShot:
    lit, stripes = expose_scene(setup, board_scene(setup, pose), number)
    views = find_boards(lit, [apparatus.BOARD], pair="chapter", shot=shot)
    if not views:
        raise BoardNotFound("the simulated board was not found", where=f"shot {shot}")
    return StripedShot(views[0], stripes)


def _expose(setup: ChapterSetup, surfaces: Sequence[Surface], number: int) -> SceneCapture:
    _, stripes = expose_scene(setup, surfaces, number)
    truth = compute_pixel_truth(Scene(surfaces), apparatus.CAMERA, setup.projector)
    return SceneCapture(stripes, truth)


def _label_spheres(setup: ChapterSetup, truth: PixelTruth) -> Indices:
    """Label pixels (H, W) by the sphere they see and the projector lights, -1 elsewhere."""
    camera = setup.view.camera
    points = camera.directions(camera.grid()) * truth.depth[..., None]
    distances = np.abs(
        np.linalg.norm(points[..., None, :] - apparatus.CENTRES, axis=-1) - apparatus.RADIUS_MM
    )
    distances = np.nan_to_num(distances, nan=np.inf)
    nearest = np.argmin(distances, axis=-1)
    on = (distances.min(axis=-1) < 0.02) & np.isfinite(truth.s)
    return np.where(on, nearest, -1).astype(np.int64)


def _mask_plate(truth: PixelTruth) -> Mask:
    """Mask pixels (H, W) on the lit plate, clear of its rim."""
    near = (np.nan_to_num(truth.depth, nan=np.inf) < 600.0) & np.isfinite(truth.s)
    window = np.ones((9, 9), np.uint8)
    return cv2.erode(near.astype(np.uint8), window, borderValue=0) > 0
