"""The chapter's own set-up (section 4), simulated: camera, rotating mirror, board, five spheres; and
the images that the camera takes of them.

The chapter does not say where the projector stood, how the boards were turned or where the spheres
lay; these are chosen so that everything fits into the image, at about 400 mm.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from itertools import count

import cv2
import numpy as np
import open3d as o3d

from bodyscan.arrays import Array, Bytes, Indices, Mask
from bodyscan.boards.detection import find_boards
from bodyscan.boards.view import BoardView
from bodyscan.errors import BoardNotFound
from bodyscan.geometry.light_planes import orient_towards_camera
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.progress import Progress, silent
from bodyscan.rig.board import Board
from bodyscan.rig.frame_names import FrameNames
from bodyscan.simulation.board import MadeBoard, make_board
from bodyscan.simulation.lamps import Lamps
from bodyscan.simulation.layout import build_mirror, sample_view_volume
from bodyscan.simulation.lens import TrueCamera
from bodyscan.simulation.projector import MirrorProjector
from bodyscan.simulation.rays import View
from bodyscan.simulation.render import PixelTruth, compute_pixel_truth, render_pair
from bodyscan.simulation.scene import Scene, Surface, build_grid_surface
from bodyscan.simulation.sensor import expose
from bodyscan.simulation.settings import BoardMaking, Noise, Optics, Projection, SimulationSettings
from bodyscan.stripes.codes.gray import Gray
from bodyscan.stripes.decoding import decode_stripes
from bodyscan.stripes.stripe_map import StripeMap

CAMERA = TrueCamera(1061.71, 1064.09, -0.562002, 350.08, 286.547, -0.140279, -0.0916363, 640, 480)
"""Table 1, to the last digit."""
PROJECTOR = Gray(stripes=254, direction="vertical")
BOARD = Board(name="board", columns=9, rows=7, square_mm=20, margin_mm=15)
"""8 x 6 = 48 inner corners, 20 mm apart."""
RADIUS_MM = 25.0
DISTANCE_MM = 400.0
CENTRES = np.array(
    [
        [-73.0, -50.0, 405.0],
        [-11.0, -50.0, 405.0],
        [51.0, -50.0, 405.0],
        [-42.0, 8.0, 385.0],
        [20.0, 8.0, 385.0],
    ]
)
"""No. 1 to 5, from top left to bottom right."""


class Stream(IntEnum):
    """Streams of random numbers by purpose."""

    RAYS = 1
    BOARD_MAKING = 2
    STAGE = 3
    NOISE = 4


@dataclass(frozen=True, eq=False)
class ChapterSetup:
    """The simulated set-up, all in the camera's frame."""

    settings: SimulationSettings
    projector: MirrorProjector  # a mirror whose surface lies off its axis
    board: MadeBoard
    view: View
    seed: int  # of all noise


def make_ideal_settings(samples: int = 5) -> SimulationSettings:
    """Make settings of a flat, exact board and the simulator's own noise.

    samples: rays per pixel along each axis. With 3 their positions alone move a boundary by 0.015
        px, as much as the noise does; with 5 by 0.005 px.
    """
    return SimulationSettings(optics=Optics(samples=samples))


def make_real_settings(samples: int = 5) -> SimulationSettings:
    """Make settings of realistic light and a realistic board."""
    return SimulationSettings(
        optics=Optics(samples=samples, defocus_px=2.0),
        projection=Projection(
            jitter_stripes=0.01, smile_stripes=0.2, speckle=0.06, defocus_stripes=1.0
        ),
        noise=Noise(photons=1.0 / 3.0),
        board=BoardMaking(bow_mm=0.1, print_error_mm=0.02),
    )


def build_chapter_setup(settings: SimulationSettings, seed: int = 0) -> ChapterSetup:
    """Build the set-up; its projector is the same whatever the seed."""
    # Behind the camera's lens, so that baselines decrease with the stripe's number (Fig. 6).
    x, y, z = -150.0, 0.0, -25.0
    turn = [0.0, float(np.arctan2(-x, DISTANCE_MM - z)), 0.0]
    projector = build_mirror(
        RigidTransform.from_rotation_vector(turn, [x, y, z]),
        PROJECTOR.stripes,
        False,
        sample_view_volume(CAMERA, (375.0, 400.0, 430.0)),
        settings.projection,
        np.random.default_rng(1),
    )
    return ChapterSetup(
        settings,
        projector,
        make_board(BOARD, settings.board, np.random.default_rng([seed, Stream.BOARD_MAKING])),
        View.from_camera(CAMERA, settings.optics, np.random.default_rng([seed, Stream.RAYS])),
        seed,
    )


def compute_true_planes(setup: ChapterSetup) -> Array:
    """Compute planes (S + 1, 4) of the boundaries before any smile; (a, b, c) unit, d >= 0."""
    return orient_towards_camera(setup.projector.plane(np.arange(setup.projector.stripes + 1.0)))


def list_board_poses(count: int = 3) -> list[RigidTransform]:
    """List camera_from_board of the first `count` of ten fixed poses (the chapter: three)."""
    # The board's middle, mm, and its rotation; the first three, and more if they are not enough.
    poses = (
        ((-11.0, -17.0, 400.0), (0.0, 0.45, 0.02)),
        ((-11.0, -17.0, 405.0), (0.42, -0.1, -0.03)),
        ((-11.0, -17.0, 400.0), (-0.3, -0.38, 0.02)),
        ((-20.0, -10.0, 380.0), (0.35, 0.3, 0.1)),
        ((5.0, -25.0, 420.0), (-0.4, 0.25, -0.2)),
        ((-15.0, -20.0, 430.0), (0.1, -0.5, 0.4)),
        ((-5.0, -10.0, 390.0), (-0.1, 0.55, -0.35)),
        ((-25.0, -20.0, 415.0), (0.5, -0.35, 0.15)),
        ((-11.0, -17.0, 410.0), (0.0, 0.05, 0.8)),
        ((0.0, -25.0, 395.0), (-0.25, -0.2, -0.6)),
    )
    return [compute_pose_about(middle, turn) for middle, turn in poses[:count]]


def stage_readings(count: int = 7) -> Array:
    """Space the slide stage's nominal stops, mm, evenly over its range."""
    return np.linspace(-60.0, 60.0, count)


def stage_poses(readings: Array, seed: int) -> list[RigidTransform]:
    """List camera_from_board at each stop, along the board's normal, with the stage's errors."""
    rng = np.random.default_rng([seed, Stream.STAGE])
    stage = compute_pose_about((-11.0, -17.0, 400.0), (0.12, -0.16, 0.02))
    stops = readings + 0.01 * rng.standard_normal(len(readings))
    slides = [RigidTransform.from_translation([0.0, 0.0, stop]) for stop in stops]
    return [stage @ slide for slide in slides]


def compute_pose_about(
    position: Sequence[float], turn: Sequence[float], middle: Array | None = None
) -> RigidTransform:
    """Compute camera_from_board that puts the board's middle at a position, rotated about it."""
    if middle is None:
        middle = BOARD.square_mm / 2.0 * np.array([BOARD.columns, BOARD.rows, 0.0])
    rotation = RigidTransform.from_rotation_vector(turn, np.zeros(3)).rotation
    return RigidTransform(rotation, np.asarray(position) - rotation @ middle)


def build_spheres() -> list[Surface]:
    """Build five white spheres on the ground, and a wall behind."""
    mesh = o3d.geometry.TriangleMesh.create_sphere(RADIUS_MM, resolution=400)
    arms = np.asarray(mesh.vertices)
    ball = Surface(arms, np.asarray(mesh.triangles), 0.8, normals=arms / RADIUS_MM)
    spheres = [replace(ball, vertices=arms + centre) for centre in CENTRES]
    return [*spheres, _build_ground(), _build_wall()]


def build_plate_scene() -> list[Surface]:
    """Build a flat white plate, smaller than the board: no calibration reaches farther."""
    pose = compute_pose_about((-11.0, -17.0, 402.0), (0.15, 0.1, 0.0), middle=np.zeros(3))
    width, height = 160.0, 120.0
    across, down = np.array([width, 0.0, 0.0]), np.array([0.0, height, 0.0])
    plate = build_grid_surface(-0.5 * (across + down), across, down, albedo=0.8)
    return [replace(plate, open_to_light=True).transform(pose), _build_wall()]


def expose_scene(
    setup: ChapterSetup, surfaces: Sequence[Surface], number: int
) -> tuple[Bytes, StripeMap]:
    """Render the sequence, `number` selecting its noise; return the lit image and decoded stripes."""
    rng = np.random.default_rng([setup.seed, Stream.NOISE, number])
    settings = setup.settings
    lamps = Lamps(255.0, 13.0, DISTANCE_MM * 1.05, DISTANCE_MM)
    images = render_pair(
        Scene(surfaces), setup.view, setup.projector, lamps, settings.projection, rng
    )
    frames = {name: expose(image, settings.noise, rng) for name, image in images.items()}
    coded = np.stack([frames[name] for name in FrameNames().code_names(PROJECTOR)])
    return frames["lit"], decode_stripes(PROJECTOR, frames["lit"], frames["dark"], coded)


def _build_ground() -> Surface:
    """Build the plane on which all five spheres lie."""
    across, down = np.array([1.0, 0.0, 0.0]), CENTRES[3] - CENTRES[0]
    down = (down - (down @ across) * across) / np.linalg.norm(down[1:])
    below = CENTRES[1] + RADIUS_MM * np.cross(across, down)
    return build_grid_surface(
        below - 300.0 * (across + down), 600.0 * across, 600.0 * down, albedo=0.5
    )


def _build_wall() -> Surface:
    corner = np.array([-1500.0, -1500.0, 2.0 * DISTANCE_MM])
    across, down = np.array([3000.0, 0.0, 0.0]), np.array([0.0, 3000.0, 0.0])
    return build_grid_surface(corner, across, down, albedo=0.3, encloses=True)


@dataclass(frozen=True, eq=False)
class StripedShot:
    """One board in one shot: its corners, and the stripes that fell on it."""

    view: BoardView
    stripes: StripeMap


@dataclass(frozen=True, eq=False)
class SceneCapture:
    """One scene: its stripes, and the truth."""

    stripes: StripeMap
    truth: PixelTruth


@dataclass(frozen=True, eq=False)
class ChapterCaptures:
    """All captures."""

    setup: ChapterSetup
    boards: tuple[StripedShot, ...]  # the three poses, or as many as were asked for
    # stage, readings: a board on a slide stage, and its readings (mm).
    stage: tuple[StripedShot, ...]
    readings: Array
    spheres: SceneCapture
    plate: SceneCapture
    # (H, W) number of the sphere that a pixel's centre sees and the projector lights, or -1.
    owner: Indices
    on_plate: Mask  # (H, W) pixels on the plate, clear of its rim


def take_captures(
    setup: ChapterSetup, *, boards: int = 3, stage_stops: int = 7, progress: Progress = silent
) -> ChapterCaptures:
    """Render, expose and decode everything. Raises BoardNotFound if a board is not found."""
    readings = stage_readings(stage_stops)
    poses, stage = list_board_poses(boards), stage_poses(readings, setup.seed)
    total = boards + len(stage) + 2
    progress("rendering", 0, total)
    shots = []
    for pose, stream in [*zip(poses, count(), strict=False), *zip(stage, count(100), strict=False)]:
        shots.append(_capture_board_shot(setup, pose, stream))
        progress("rendering", len(shots), total)
    spheres = _expose(setup, build_spheres(), 200)
    progress("rendering", total - 1, total)
    plate = _expose(setup, build_plate_scene(), 300)
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


def _capture_board_shot(setup: ChapterSetup, pose: RigidTransform, number: int) -> StripedShot:
    """Capture the board, and a wall behind it."""
    surfaces = [*(surface.transform(pose) for surface in setup.board.surfaces), _build_wall()]
    lit, stripes = expose_scene(setup, surfaces, number)
    views = find_boards(lit, [BOARD], pair="chapter", shot=f"shot{number}")
    if not views:
        raise BoardNotFound("the simulated board was not found", where=f"shot {number}")
    return StripedShot(views[0], stripes)


def _expose(setup: ChapterSetup, surfaces: Sequence[Surface], number: int) -> SceneCapture:
    _, stripes = expose_scene(setup, surfaces, number)
    truth = compute_pixel_truth(Scene(surfaces), CAMERA, setup.projector)
    return SceneCapture(stripes, truth)


def _label_spheres(setup: ChapterSetup, truth: PixelTruth) -> Indices:
    """Label pixels (H, W) by the sphere they see and the projector lights, -1 elsewhere."""
    camera = setup.view.camera
    points = camera.directions(camera.grid()) * truth.depth[..., None]
    distances = np.abs(np.linalg.norm(points[..., None, :] - CENTRES, axis=-1) - RADIUS_MM)
    distances = np.nan_to_num(distances, nan=np.inf)
    nearest = np.argmin(distances, axis=-1)
    on = (distances.min(axis=-1) < 0.02) & np.isfinite(truth.s)
    return np.where(on, nearest, -1).astype(np.int64)


def _mask_plate(truth: PixelTruth) -> Mask:
    """Mask pixels (H, W) on the lit plate, clear of its rim."""
    near = (np.nan_to_num(truth.depth, nan=np.inf) < 600.0) & np.isfinite(truth.s)
    window = np.ones((9, 9), np.uint8)
    return cv2.erode(near.astype(np.uint8), window, borderValue=0) > 0
