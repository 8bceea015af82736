"""The chapter's own set-up (section 4), simulated: camera, rotating mirror, board, five spheres.

The chapter does not say where the projector stood, how the boards were turned or where the spheres
lay; these are chosen so that everything fits into the image, at about 400 mm.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from bodyscan.arrays import Array
from bodyscan.geometry.light_planes import towards_camera
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.rig.board import Board
from bodyscan.simulation.board import MadeBoard, make_board
from bodyscan.simulation.layout import build_mirror, sample_view_volume
from bodyscan.simulation.lens import TrueCamera
from bodyscan.simulation.projector import MirrorProjector
from bodyscan.simulation.rays import View
from bodyscan.simulation.settings import BoardMaking, Noise, Optics, Projection, SimulationSettings
from bodyscan.stripes.codes.gray import Gray

CAMERA = TrueCamera(1061.71, 1064.09, -0.562002, 350.08, 286.547, -0.140279, -0.0916363, 640, 480)
"""Table 1, to the last digit."""
PROJECTOR = Gray(stripes=254, direction="vertical")
BOARD = Board(name="board", columns=9, rows=7, square_mm=20, margin_mm=15)
"""8 x 6 = 48 inner corners, 20 mm apart."""
RADIUS_MM = 25.0
DISTANCE_MM = 400.0
BOARDS = 3
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
    """The simulated set-up, all in the camera's frame.

    projector: a mirror whose surface lies off its axis.
    seed: of all noise.
    """

    settings: SimulationSettings
    projector: MirrorProjector
    board: MadeBoard
    view: View
    seed: int


def ideal_settings(samples: int = 5) -> SimulationSettings:
    """Make settings of a flat, exact board and the simulator's own noise.

    samples: rays per pixel along each axis. With 3 their positions alone move a boundary by 0.015
        px, as much as the noise does; with 5 by 0.005 px.
    """
    return SimulationSettings(optics=Optics(samples=samples))


def real_settings(samples: int = 5) -> SimulationSettings:
    """Make settings of realistic light and a realistic board."""
    return SimulationSettings(
        optics=Optics(samples=samples, defocus_px=2.0),
        projection=Projection(
            jitter_stripes=0.01, smile_stripes=0.2, speckle=0.06, defocus_stripes=1.0
        ),
        noise=Noise(photons=1.0 / 3.0),
        board=BoardMaking(bow_mm=0.1, print_error_mm=0.02),
    )


def chapter_setup(settings: SimulationSettings, seed: int = 0) -> ChapterSetup:
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


def true_planes(setup: ChapterSetup) -> Array:
    """Compute planes (S + 1, 4) of the boundaries before any smile; (a, b, c) unit, d >= 0."""
    return towards_camera(setup.projector.plane(np.arange(setup.projector.stripes + 1.0)))


def board_poses(count: int = BOARDS) -> list[RigidTransform]:
    """List camera_from_board of the three poses, or of `count` poses."""
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
    return [pose_about(middle, turn) for middle, turn in poses[:count]]


def stage_readings(count: int = 7) -> Array:
    """Space the slide stage's nominal stops, mm, evenly over its range."""
    return np.linspace(-60.0, 60.0, count)


def stage_poses(readings: Array, seed: int) -> list[RigidTransform]:
    """List camera_from_board at each stop, along the board's normal, with the stage's errors."""
    rng = np.random.default_rng([seed, Stream.STAGE])
    stage = pose_about((-11.0, -17.0, 400.0), (0.12, -0.16, 0.02))
    stops = readings + 0.01 * rng.standard_normal(len(readings))
    slides = [RigidTransform.from_translation([0.0, 0.0, stop]) for stop in stops]
    return [stage @ slide for slide in slides]


def pose_about(
    position: Sequence[float], turn: Sequence[float], middle: Array | None = None
) -> RigidTransform:
    """Compute camera_from_board that puts the board's middle at a position, rotated about it."""
    if middle is None:
        middle = BOARD.square_mm / 2.0 * np.array([BOARD.columns, BOARD.rows, 0.0])
    rotation = RigidTransform.from_rotation_vector(turn, np.zeros(3)).rotation
    return RigidTransform(rotation, np.asarray(position) - rotation @ middle)
