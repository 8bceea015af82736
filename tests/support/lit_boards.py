"""Boards lit by projectors of known make: nothing here is shared with the models under test."""

from __future__ import annotations

import pickle
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Protocol

import numpy as np
from table_one import CAMERA

from bodyscan.arrays import Array, Indices
from bodyscan.calibration.board_views import PlanarView
from bodyscan.calibration.boundary_points import (
    BoardBoundaries,
    BoundaryPoints,
    bin_boundaries,
    boundary_points,
    concatenate,
)
from bodyscan.calibration.camera import locate_board
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses.opencv import Radial
from bodyscan.geometry.light_planes import Axis
from bodyscan.geometry.transforms import RigidTransform


class Projector(Protocol):
    @property
    def stripes(self) -> int: ...

    def stripe(self, points: Array) -> Array: ...


@dataclass(frozen=True)
class Mirror:
    """A laser sheet swept by a mirror whose surface lies `offset` off its axis; s linear in angle. The
    mirror turns about `axis` through `centre`; at angle 0 it sends the light along `out`. The sheet
    comes from the side, 30 mm off, and is tilted by `tilt` against the axis. smile: the stripes' ends
    are bowed by so many stripes where the fan's tangent is 0.4."""

    stripes: int
    centre: Array
    out: Array
    axis: Array
    offset: float = 7.0
    tilt: float = 0.02
    sweep: float = 0.34
    smile: float = 0.0

    def stripe(self, points: Array) -> Array:
        out = self.out / np.linalg.norm(self.out)
        back = np.cross(self.axis, out)
        laser = self.centre + 30.0 * back
        sheet = np.cos(self.tilt) * out + np.sin(self.tilt) * self.axis
        zero, side = (out + back) / np.sqrt(2.0), (back - out) / np.sqrt(2.0)

        def beside(angle: Array) -> tuple[Array, Array]:
            """How far points lie beside the sheet that the mirror throws at an angle."""
            normal = np.cos(angle)[:, None] * zero + np.sin(angle)[:, None] * side
            height = normal @ (laser - self.centre) - self.offset
            apex = laser - 2.0 * height[:, None] * normal
            thrown = sheet - 2.0 * (normal @ sheet)[:, None] * normal
            return np.sum(thrown * (points - apex), axis=1), apex

        angle = np.zeros(len(points))
        for _ in range(5):
            off = beside(angle)[0]
            angle -= off * 1e-5 / (beside(angle + 1e-5)[0] - off)
        away = points - beside(angle)[1]
        fan = (away @ self.axis) / (away @ out)
        return self.stripes * (angle / self.sweep + 0.5) + self.smile * (fan / 0.4) ** 2


@dataclass(frozen=True)
class Lens:
    """A projector with a centre and a lens (k1, k2), its axis at stripe `centre`."""

    stripes: int
    projector_from_camera: RigidTransform
    focal: float
    centre: float
    k1: float
    k2: float = 0.0

    def stripe(self, points: Array) -> Array:
        x, y, z = self.projector_from_camera.apply(points).T
        square = (x / z) ** 2 + (y / z) ** 2
        return self.centre + self.focal * y / z * (1.0 + self.k1 * square + self.k2 * square**2)


@dataclass(frozen=True)
class Uneven:
    """The same light, each boundary out of place by its share of a stripe, at most `size`."""

    light: Projector
    size: float

    @property
    def stripes(self) -> int:
        return self.light.stripes

    def stripe(self, points: Array) -> Array:
        moved = np.random.default_rng(8).uniform(-self.size, self.size, self.stripes + 1)
        true = np.arange(self.stripes + 1) + moved
        return np.interp(self.light.stripe(points), true, np.arange(self.stripes + 1.0))


@dataclass(frozen=True)
class Scene:
    """One pair and its board: columns x rows squares."""

    camera: Camera
    projector: Projector
    direction: Axis
    square: float
    columns: int
    rows: int

    @property
    def size(self) -> Array:
        return self.square * np.array([self.columns, self.rows])

    def looking_at(self, middle: Sequence[float], turn: Sequence[float]) -> RigidTransform:
        """camera_from_board of a board whose middle is there, turned from facing the camera."""
        rotation = RigidTransform.from_rotation_vector(turn, np.zeros(3)).rotation
        return RigidTransform(rotation, middle - rotation @ np.append(self.size / 2.0, 0.0))

    def on_plane(self, pixels: Array, camera_from_board: RigidTransform) -> Array:
        normal = camera_from_board.rotation[:, 2]
        rays = self.camera.rays(pixels)
        return rays * (normal @ camera_from_board.translation / (rays @ normal))[:, None]

    def on_board(self, pixels: Array, camera_from_board: RigidTransform) -> Array:
        """Where pixels' rays meet the board, (N, 2) mm, board frame."""
        met = camera_from_board.inverse().apply(self.on_plane(pixels, camera_from_board))
        return met[:, :2]

    def crossings(
        self, camera_from_board: RigidTransform, every_px: int = 8
    ) -> tuple[Indices, Array]:
        """Boundaries and the pixels where they cross every n-th line of the image, on the board."""
        index, pixels = _crossings(pickle.dumps((self, camera_from_board, every_px)))
        return index, pixels.copy()

    def _crossings(self, camera_from_board: RigidTransform, every_px: int) -> tuple[Indices, Array]:
        tall = self.direction == "horizontal"
        width, height = self.camera.width, self.camera.height
        lines = np.arange(0.0, width if tall else height, every_px)
        wanted = np.arange(1.0, self.projector.stripes)

        def pixels_at(line: Array, place: Array) -> Array:
            return np.column_stack([line, place] if tall else [place, line])

        def stripe(line: Array, place: Array) -> Array:
            met = self.on_plane(pixels_at(line, place), camera_from_board)
            return self.projector.stripe(met)

        coarse = np.linspace(0.0, height if tall else width, 40)
        first = stripe(np.repeat(lines, 40), np.tile(coarse, len(lines))).reshape(-1, 40)
        rises = 1 if first[0, -1] > first[0, 0] else -1
        place = np.stack(
            [np.interp(wanted, row[::rises], coarse[::rises]) for row in first]
        ).ravel()
        line, wanted = np.repeat(lines, len(wanted)), np.tile(wanted, len(lines))
        with np.errstate(all="ignore"):
            # Most of the picture is beside the board: no need to look there any closer.
            on_board = self.on_board(pixels_at(line, place), camera_from_board)
            near = np.all((on_board > -self.square) & (on_board < self.size + self.square), axis=1)
            line, wanted, place = line[near], wanted[near], place[near]
            for _ in range(3):
                s = stripe(line, place)
                slope = (stripe(line, place + 0.5) - s) / 0.5
                place = place - (s - wanted) / slope
            s, pixels = stripe(line, place), pixels_at(line, place)
            on_board = self.on_board(pixels, camera_from_board)
        seen = (np.abs(s - wanted) < 1e-6) & np.all(pixels > 0, axis=1)
        seen &= np.all(pixels < [width - 1, height - 1], axis=1)
        seen &= np.all((on_board > 0) & (on_board < self.size), axis=1)
        return wanted[seen].astype(np.int64), pixels[seen]

    def boundaries(
        self,
        poses: Sequence[RigidTransform],
        noise_px: float = 0.05,
        corner_px: float = 0.05,
        seed: int = 1,
    ) -> BoundaryPoints:
        """As a calibration sees them: noisy, on boards placed by their noisy corners."""
        rng = np.random.default_rng(seed)
        parts = []
        across = 1 if self.direction == "horizontal" else 0
        for number, pose in enumerate(poses):
            index, pixels = self.crossings(pose)
            pixels[:, across] += rng.normal(0.0, noise_px, len(pixels))
            placed = self.placed(pose, corner_px, rng) if corner_px else pose
            means = binned(index, pixels, max(noise_px, 0.01), self.direction)
            seen = self.camera, placed, *means
            parts.append(boundary_points(*seen, board=number, direction=self.direction))
        return concatenate(parts)

    def placed(
        self, pose: RigidTransform, corner_px: float, rng: np.random.Generator
    ) -> RigidTransform:
        """The board's pose from its corners, found with so much noise."""
        grid = np.meshgrid(np.arange(1, self.columns), np.arange(1, self.rows))
        corners = np.column_stack([*(self.square * axis.ravel() for axis in grid)])
        corners = np.column_stack([corners, np.zeros(len(corners))])
        pixels = self.camera.project(pose.apply(corners))
        noisy = pixels + rng.normal(0.0, corner_px, pixels.shape)
        return locate_board(self.camera, PlanarView("", corners, noisy))[0]

    def true_depth(self, rays: Array, s: Array, start: Array) -> Array:
        """What perfect sheets make of s, by Newton's method."""
        depth = start.copy()
        for _ in range(6):
            off = self.projector.stripe(rays * depth[:, None]) - s
            further = self.projector.stripe(rays * (depth + 0.1)[:, None]) - s
            depth -= off * 0.1 / (further - off)
        return depth


@cache
def _crossings(of: bytes) -> tuple[Indices, Array]:
    """Once for the many draws of noise that tests add; `of`: scene, pose, pixels between lines."""
    scene, camera_from_board, every_px = pickle.loads(of)
    found: tuple[Indices, Array] = scene._crossings(camera_from_board, every_px)
    return found


def chapter_scene(**mirror: float) -> Scene:
    """Table 1's camera, 254 vertical stripes from a rotating mirror, a board of 48 corners."""
    centre, out = np.array([130.0, 5.0, 20.0]), np.array([-130.0, 0.0, 390.0])
    projector = Mirror(254, centre, out, np.array([0.0, 1.0, 0.0]), **mirror)
    return Scene(CAMERA, projector, "vertical", 20.0, 9, 7)


Pose = tuple[Sequence[float], Sequence[float]]
"""Of a board: its middle and its turn, see `Scene.looking_at`."""

CHAPTER_POSES: tuple[Pose, ...] = (
    ([0.0, 0.0, 380.0], [0.35, 0.2, 0.1]),
    ([5.0, 5.0, 400.0], [-0.3, 0.25, 0.0]),
    ([-5.0, -5.0, 420.0], [0.05, -0.45, -0.1]),
)


def body_scene(k1: float, k2: float = 0.0, axis: float = 330.0) -> Scene:
    """A pair of a body scanner: 1280 x 1024 px, 640 horizontal stripes from above, 1.3 m away.

    axis: the stripe that the projector's lens looks along."""
    camera = Camera(1510.0, 1513.0, -0.5, 645.0, 508.0, Radial(-0.1, 0.05), 1280, 1024)
    focal = 730.0
    # The middle of the image is to be lit by stripe 320, wherever the lens looks.
    tilt = np.arctan(280.0 / 1300.0) - np.arctan((320.0 - axis) / focal)
    rotation = RigidTransform.from_rotation_vector([tilt, 0.0, 0.0], np.zeros(3))
    turned = RigidTransform.from_rotation_vector([0.0, 0.02, 0.01], np.zeros(3))
    place = RigidTransform(np.eye(3), np.array([-15.0, 280.0, 5.0]))
    projector = Lens(640, turned @ rotation @ place, focal, axis, k1, k2)
    return Scene(camera, projector, "horizontal", 70.0, 9, 7)


BODY_POSES: tuple[Pose, ...] = (
    ([0.0, -140.0, 1150.0], [0.3, 0.2, 0.0]),
    ([20.0, 150.0, 1250.0], [-0.35, 0.3, 0.1]),
    ([-30.0, 0.0, 1400.0], [0.1, -0.4, 1.6]),
    ([40.0, -190.0, 1420.0], [-0.2, -0.3, 0.0]),
)


def binned(
    index: Indices, pixels: Array, sigma_px: float, direction: Axis
) -> tuple[Indices, Array, Array]:
    """Boundaries (N,) at pixels (N, 2) as calibrations take them: means over pieces, their sigmas."""
    seen = BoardBoundaries(index, pixels, np.full(len(index), sigma_px))
    means = bin_boundaries(seen, np.ones(len(index), np.bool_), direction)
    return means.index, means.pixels, means.sigma_px
