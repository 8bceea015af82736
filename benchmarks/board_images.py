"""Lit images of a simulated rig's boards, without stripes and room: a second per view, not minutes.

The simulator's own cameras, plan of shots, prints, blur and sensor noise; the board alone, flat,
against grey, lit from the projector. Corners are then found as in real images.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from bodyscan.arrays import Floats
from bodyscan.boards.detection import find_boards
from bodyscan.boards.view import BoardView
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.rig.board import Board
from bodyscan.rig.rig import Rig
from bodyscan.simulation.board import make_print
from bodyscan.simulation.layout import TruePair, build_pairs
from bodyscan.simulation.lens import sample_directions
from bodyscan.simulation.plan import BoardShot, count_default_shots, plan_boards
from bodyscan.simulation.sensor import choose_exposure, expose
from bodyscan.simulation.settings import SimulationSettings

BACKGROUND = 0.25
TEXELS_PER_MM = 8
SETTINGS = SimulationSettings()


@dataclass(frozen=True, eq=False)
class SeenRig:
    """A rig, its true pairs by name, the shots, and every board view that a detector found."""

    rig: Rig
    pairs: dict[str, TruePair]
    shots: tuple[BoardShot, ...]
    views: tuple[BoardView, ...]


def see_boards(
    rig: Rig, *, seed: int, shots: int | None = None, workers: int = 2, stored: Path | None = None
) -> SeenRig:
    """Draw a rig and a plan of board shots, render every view, find the corners.

    stored: an npz file of corners, read if it exists, else written: the same arguments give the
        same corners.
    """
    pairs = build_pairs(rig, SETTINGS, lambda k: np.random.default_rng([seed, 1, k]))
    count = shots or count_default_shots(len(pairs))
    plan = plan_boards(rig, pairs, count, np.random.default_rng([seed, 3]))
    if stored is not None and stored.exists():
        return SeenRig(rig, pairs, tuple(plan), load_views(stored))
    board = rig.boards[0]
    textures = [_make_texture(board, face) for face in range(board.faces)]

    def see(number: int) -> list[BoardView]:
        pair = list(pairs.values())[number]
        return list(_views_of(pair, board, textures, plan, seed, number))

    with ThreadPoolExecutor(workers) as pool:
        found = list(pool.map(see, range(len(pairs))))
    views = tuple(view for part in found for view in part)
    if stored is not None:
        save_views(views, stored)
    return SeenRig(rig, pairs, tuple(plan), views)


def save_views(views: Sequence[BoardView], path: Path) -> None:
    """Save corners as npz: per view one row of `which` (pair, shot, board) and of `turnable`; the
    corners of all views concatenated, with their numbers in `counts`."""
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(
        path,
        which=np.array([view.key for view in views]),
        turnable=np.array([view.turnable for view in views]),
        counts=np.array([len(view.pixels) for view in views]),
        ids=np.concatenate([view.corner_ids for view in views]),
        pixels=np.concatenate([view.pixels for view in views]),
    )


def load_views(path: Path) -> tuple[BoardView, ...]:
    """Views that `save_views` wrote."""
    with np.load(path) as stored:
        cuts = np.cumsum(stored["counts"])[:-1]
        parts = zip(
            stored["which"].tolist(),
            np.split(stored["ids"], cuts),
            np.split(stored["pixels"], cuts),
            stored["turnable"].tolist(),
            strict=True,
        )
        return tuple(
            BoardView(pair, shot, board, ids, pixels, turnable)
            for (pair, shot, board), ids, pixels, turnable in parts
        )


def _views_of(
    pair: TruePair,
    board: Board,
    textures: list[Floats],
    plan: list[BoardShot],
    seed: int,
    number: int,
) -> Iterator[BoardView]:
    samples = SETTINGS.optics.samples
    shift = np.random.default_rng([seed, 6, number]).random((*pair.camera.grid().shape[:2], 2))
    rays = sample_directions(pair.camera, samples, shift, slice(None))
    planes = np.ascontiguousarray(
        rays[:, :2]
        .reshape(pair.camera.height, pair.camera.width, samples**2, 2)
        .transpose(2, 0, 1, 3)
    )
    del rays
    for shot_number, shot in enumerate(plan):
        if pair.name in (*shot.stripes, *shot.lit):
            noise = np.random.default_rng([seed, 7, number, shot_number])
            camera_from_board = pair.rig_from_camera.inverse() @ shot.rig_from_board
            lit = _render(pair, board, textures, camera_from_board, planes)
            length = choose_exposure(lit, SETTINGS.lighting.board_grey, SETTINGS.lighting)
            image = expose(lit * length, SETTINGS.noise, noise)
            yield from find_boards(image, [board], pair=pair.name, shot=shot.name)


def _render(
    pair: TruePair,
    board: Board,
    textures: list[Floats],
    camera_from_board: RigidTransform,
    planes: Floats,
) -> Floats:
    """Grey levels (height, width) before exposure; planes: (samples, height, width, 2) rays."""
    face = 0 if camera_from_board.rotation[:, 2] @ camera_from_board.translation > 0 else 1
    face_from_print = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0], [0, 0, 1.0]])
    if face:
        face_from_print[0] = [-1.0, 0.0, board.columns * board.square_mm]
        face_from_print[2] = [0.0, 0.0, board.thickness_mm]
    ray_from_print = (camera_from_board.matrix @ face_from_print)[:3]
    texel_from_mm = np.array(
        [[1.0, 0.0, board.margin_mm], [0.0, 1.0, board.margin_mm], [0.0, 0.0, 1.0 / TEXELS_PER_MM]]
    )
    texel_from_mm = texel_from_mm * TEXELS_PER_MM - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
    texel_from_ray = (texel_from_mm @ np.linalg.inv(ray_from_print)).astype(np.float64)
    albedo = np.zeros(planes.shape[1:3], np.float32)
    for rays in planes:
        place = cv2.perspectiveTransform(rays, texel_from_ray)
        albedo += cv2.remap(
            textures[face],
            place,
            None,
            cv2.INTER_NEAREST,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=BACKGROUND,
        )
    lighting = SETTINGS.lighting
    light = lighting.laser_grey * _shading(pair, camera_from_board, planes[0])
    image = albedo / len(planes) * (light + lighting.ambient_grey)
    return np.asarray(cv2.GaussianBlur(image, (0, 0), SETTINGS.optics.blur_px), np.float32)


def _shading(pair: TruePair, camera_from_board: RigidTransform, rays: Floats) -> Floats:
    """Cosine over squared distance (in working distances) of the light on the board's plane."""
    normal = camera_from_board.rotation[:, 2].astype(np.float32)
    height = np.float32(normal @ camera_from_board.translation)
    slope = rays @ normal[:2] + normal[2]
    # Off the board its plane may be edge-on or behind the camera: only the board itself counts.
    steep = np.where(np.abs(slope) < 1e-3, np.float32(1e-3), slope)
    depth = np.clip(height / steep, 0.3 * pair.reach_mm, 3.0 * pair.reach_mm)
    source = np.asarray(pair.projector.source(np.array([pair.projector.stripes / 2.0])))[0]
    towards = [np.float32(source[k]) - (rays[..., k] if k < 2 else 1.0) * depth for k in range(3)]
    square = towards[0] ** 2 + towards[1] ** 2 + towards[2] ** 2
    across = sum(n * t for n, t in zip(normal, towards, strict=True))
    at = np.float32((0.85 * pair.reach_mm) ** 2)
    return np.asarray(at * np.abs(across) / square**1.5, np.float32)


def _make_texture(board: Board, face: int) -> Floats:
    """The print's albedo at `TEXELS_PER_MM`, including its margin."""
    size = 2.0 * board.margin_mm + board.square_mm * np.array([board.columns, board.rows])
    x, y = (
        (np.arange(round(length * TEXELS_PER_MM)) + 0.5) / TEXELS_PER_MM - board.margin_mm
        for length in size
    )
    grid = np.stack(np.meshgrid(x, y), axis=-1).astype(np.float32)
    flat = make_print(board, face, SETTINGS.board).albedo(grid.reshape(-1, 2))
    return flat.reshape(grid.shape[:2])
