"""Pictures of boards with known corners, made by casting rays, for the tests of this folder."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from bodyscan.arrays import Array, Bytes, Floats
from bodyscan.rig.board import Board

SUPERSAMPLING = 8


@dataclass(frozen=True)
class View:
    """A board's place before a camera with square pixels and one radial coefficient.

    rotation (3, 3), translation (3,) mm: camera from board frame.
    """

    focal_px: float
    width: int
    height: int
    k1: float
    rotation: np.ndarray
    translation: np.ndarray

    def project(self, points: np.ndarray) -> np.ndarray:
        camera = points @ self.rotation.T + self.translation
        x = camera[:, :2] / camera[:, 2:]
        x = x * (1 + self.k1 * np.sum(x**2, axis=1, keepdims=True))
        return self.focal_px * x + [(self.width - 1) / 2, (self.height - 1) / 2]


def view_of(
    board: Board,
    slant_deg: int,
    azimuth_deg: int,
    spin_deg: int,
    *,
    width: int = 640,
    height: int = 512,
    fill: float = 0.8,
    k1: float = -0.1,
    back: bool = False,
    shift: tuple[float, float] = (0.0, 0.0),
) -> View:
    """The board's middle in the picture's middle, tilted by `slant_deg`, filling it by `fill`."""
    spin, azimuth, slant = np.radians([spin_deg, azimuth_deg, slant_deg])
    axis = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    rotation = cv2.Rodrigues(axis * slant)[0] @ cv2.Rodrigues(np.array([0, 0, spin]))[0]
    if back:
        rotation = rotation @ np.diag([-1.0, 1.0, -1.0])
    size = np.array([board.columns, board.rows]) * board.square_mm
    focal = 1.3 * width
    distance = focal * np.hypot(*size) / (fill * np.hypot(width, height))
    middle = np.array([size[0] / 2, size[1] / 2, 0.0])
    translation = np.array([0, 0, distance]) - rotation @ middle
    translation[:2] += np.asarray(shift) * distance / focal
    return View(focal, width, height, k1, rotation, translation)


def true_corners(board: Board, view: View, face: int = 0) -> np.ndarray:
    """Pixels of one face's inner corners, written out here once more on purpose."""
    points = []
    for row in range(1, board.rows):
        for column in range(1, board.columns):
            x, y, z = column * board.square_mm, row * board.square_mm, 0.0
            if face == 1:
                x, z = board.columns * board.square_mm - x, board.thickness_mm
            points.append([x, y, z])
    return view.project(np.array(points))


def render(
    boards_and_views: list[tuple[Board, View]],
    *,
    blur_px: float = 0.7,
    noise: float = 1.0,
    seed: int = 0,
    white: float = 200.0,
    black: float = 20.0,
    background: float = 70.0,
    light_falloff: float = 0.0,
) -> np.ndarray:
    """Picture (H, W) uint8 of [(board, view), ...], antialiased, blurred, noisy."""
    view = boards_and_views[0][1]
    n = SUPERSAMPLING
    fine = np.full((view.height * n, view.width * n), background, np.float32)
    for board, board_view in boards_and_views:
        _paint(fine, board, board_view, white, black)
    if light_falloff:
        ramp = np.linspace(1.0, 1.0 - light_falloff, fine.shape[1], dtype=np.float32)
        fine *= ramp
    fine = cv2.GaussianBlur(fine, (0, 0), blur_px * n) if blur_px else fine
    image = fine.reshape(view.height, n, view.width, n).mean(axis=(1, 3))
    image += np.random.default_rng(seed).normal(0.0, noise, image.shape)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def _paint(fine: Floats, board: Board, view: View, white: float, black: float) -> None:
    """Colours the fine picture's samples whose rays meet the board."""
    n = SUPERSAMPLING
    face = 0 if view.rotation[:, 2] @ view.translation > 0 else 1
    size = np.array([board.columns, board.rows]) * board.square_mm
    depth = board.thickness_mm if face else 0.0
    rim = np.array(
        [
            [x, y, depth]
            for x in np.linspace(-board.margin_mm, size[0] + board.margin_mm, 9)
            for y in np.linspace(-board.margin_mm, size[1] + board.margin_mm, 9)
        ]
    )
    seen = view.project(rim)
    low = np.clip(np.floor(seen.min(axis=0)) - 2, 0, None).astype(int)
    high = np.minimum(np.ceil(seen.max(axis=0)) + 3, [view.width, view.height]).astype(int)
    u = (np.arange(low[0] * n, high[0] * n, dtype=np.float32) + 0.5) / n - 0.5
    v = (np.arange(low[1] * n, high[1] * n, dtype=np.float32) + 0.5) / n - 0.5
    x = (u[None, :] - (view.width - 1) / 2) / view.focal_px + 0 * v[:, None]
    y = (v[:, None] - (view.height - 1) / 2) / view.focal_px + 0 * u[None, :]
    scale = np.ones_like(x)
    r2 = x * x + y * y
    for _ in range(6):
        scale = 1 / (1 + view.k1 * r2 * scale * scale)
    x, y = x * scale, y * scale
    normal = view.rotation[:, 2]
    origin = view.translation + depth * normal
    distance = (normal @ origin) / (normal[0] * x + normal[1] * y + normal[2])
    board_x = (
        view.rotation[0, 0] * (x * distance - origin[0])
        + view.rotation[1, 0] * (y * distance - origin[1])
        + view.rotation[2, 0] * (distance - origin[2])
    )
    board_y = (
        view.rotation[0, 1] * (x * distance - origin[0])
        + view.rotation[1, 1] * (y * distance - origin[1])
        + view.rotation[2, 1] * (distance - origin[2])
    )
    if face:
        board_x = size[0] - board_x
    colour = _colours(board, face, board_x / board.square_mm, board_y / board.square_mm)
    values = np.array([black, white], np.float32)[colour]
    margin = board.margin_mm / board.square_mm
    inside = (board_x >= -margin * board.square_mm) & (board_x <= size[0] + board.margin_mm)
    inside &= (board_y >= -board.margin_mm) & (board_y <= size[1] + board.margin_mm)
    part = fine[low[1] * n : high[1] * n, low[0] * n : high[0] * n]
    part[inside] = values[inside]


def _colours(board: Board, face: int, x: Array, y: Array) -> NDArray[np.int32]:
    """0 black, 1 white at print coordinates in squares; outside the squares white."""
    column, row = np.floor(x).astype(np.int32), np.floor(y).astype(np.int32)
    on_print = (column >= 0) & (column < board.columns) & (row >= 0) & (row < board.rows)
    if board.kind == "checkerboard":
        return np.where(on_print, (column + row) % 2, 1)
    texture, scale = _charuco_texture(board, face), 100
    tx = np.clip((x * scale).astype(np.int32), 0, texture.shape[1] - 1)
    ty = np.clip((y * scale).astype(np.int32), 0, texture.shape[0] - 1)
    return np.where(on_print, texture[ty, tx] > 127, 1).astype(np.int32)


def _charuco_texture(board: Board, face: int) -> Bytes:
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    count = board.columns * board.rows // 2
    ids = np.arange(count) + board.first_marker + face * count
    printed = cv2.aruco.CharucoBoard(
        (board.columns, board.rows), board.square_mm, board.marker_mm, dictionary, ids
    )
    printed.setLegacyPattern(board.legacy_layout)
    return printed.generateImage((board.columns * 100, board.rows * 100))
