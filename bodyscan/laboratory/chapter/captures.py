"""All captures of the simulated camera for the experiments: boards, slide stage, spheres, plate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from bodyscan.arrays import Array, Bytes, Indices, Mask
from bodyscan.boards.detection import find_boards
from bodyscan.errors import BoardNotFound
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.laboratory.chapter import apparatus, scenes
from bodyscan.laboratory.chapter.apparatus import ChapterSetup
from bodyscan.laboratory.rivals.targets import StripedShot, Target
from bodyscan.progress import Progress, silent
from bodyscan.simulation.render import PixelTruth, pixel_truth
from bodyscan.simulation.scene import Scene, Surface
from bodyscan.stripes.stripe_map import StripeMap

TARGET = Target(apparatus.BOARD, apparatus.PROJECTOR)
ON_SPHERE_MM = 0.02
RIM_PX = 4
WALL_MM = 600.0
_BOARDS, _STAGE, _SPHERES, _PLATE = 0, 100, 200, 300


@dataclass(frozen=True, eq=False)
class SceneCapture:
    """One scene: the lit image, its stripes, the same light
    exposed a second time, and the truth."""

    lit: Bytes
    stripes: StripeMap
    again: StripeMap
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
    places, stage = apparatus.board_poses(boards), apparatus.stage_poses(readings, setup.seed)
    total = boards + len(stage) + 2
    progress("rendering", 0, total)
    shots = []
    for number, place in enumerate([*places, *stage]):
        of_stage = number - boards
        stream = _STAGE + of_stage if of_stage >= 0 else _BOARDS + number
        name = f"stage{of_stage + 1}" if of_stage >= 0 else f"board{number + 1}"
        shots.append(_board_shot(setup, place, name, stream))
        progress("rendering", number + 1, total)
    spheres = _expose(setup, scenes.sphere_scene(), _SPHERES)
    progress("rendering", total - 1, total)
    plate = _expose(setup, scenes.plate_scene(), _PLATE)
    progress("rendering", total, total)
    return ChapterCaptures(
        setup,
        tuple(shots[:boards]),
        tuple(shots[boards:]),
        readings,
        spheres,
        plate,
        _owners(setup, spheres.truth),
        _on_plate(plate.truth),
    )


def _board_shot(setup: ChapterSetup, place: RigidTransform, shot: str, number: int) -> StripedShot:
    (taken,) = scenes.expose_scene(setup, scenes.board_scene(setup, place), number)
    views = find_boards(taken.lit, [apparatus.BOARD], pair="chapter", shot=shot)
    if not views:
        raise BoardNotFound("the simulated board was not found", where=f"shot {shot}")
    return StripedShot(views[0], taken.stripes)


def _expose(setup: ChapterSetup, surfaces: Sequence[Surface], number: int) -> SceneCapture:
    first, second = scenes.expose_scene(setup, surfaces, number, times=2)
    truth = pixel_truth(Scene(surfaces), apparatus.CAMERA, setup.projector)
    return SceneCapture(first.lit, first.stripes, second.stripes, truth)


def _owners(setup: ChapterSetup, truth: PixelTruth) -> Indices:
    camera = setup.view.camera
    points = camera.directions(camera.grid()) * truth.depth[..., None]
    off = np.abs(
        np.linalg.norm(points[..., None, :] - apparatus.CENTRES, axis=-1) - apparatus.RADIUS_MM
    )
    off = np.nan_to_num(off, nan=np.inf)
    nearest = np.argmin(off, axis=-1)
    on = (off.min(axis=-1) < ON_SPHERE_MM) & np.isfinite(truth.s)
    return np.where(on, nearest, -1).astype(np.int64)


def _on_plate(truth: PixelTruth) -> Mask:
    near = (np.nan_to_num(truth.depth, nan=np.inf) < WALL_MM) & np.isfinite(truth.s)
    window = np.ones((2 * RIM_PX + 1, 2 * RIM_PX + 1), np.uint8)
    return cv2.erode(near.astype(np.uint8), window, borderValue=0) > 0
