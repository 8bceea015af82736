"""Pictures of boards with known corners, made by casting rays, for the tests of this folder."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from bodyscan.arrays import Array, Floats, Indices
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
    # Blurred at half of the fineness, which is fine enough for a blur: a quarter of the time.
    half = cv2.resize(fine, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    half = cv2.GaussianBlur(half, (0, 0), blur_px * n / 2) if blur_px else half
    image = cv2.resize(half, (view.width, view.height), interpolation=cv2.INTER_AREA)
    image = image + np.random.default_rng(seed).normal(0.0, noise, image.shape)
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
    # Where a pixel's middle meets the board, and one pixel more all round; from these the samples by
    # linear interpolation, which is off by less than 1e-4 px.
    u, v = np.arange(low[0] - 1, high[0] + 1), np.arange(low[1] - 1, high[1] + 1)
    x, y = _met(view, depth, *np.meshgrid(u, v))
    if face:
        x = size[0] - x
    print_, scale = _print(board, face, white, black)
    # In the print's pixels, while there are 64 times fewer of them.
    per_mm = scale / board.square_mm
    x, y = (
        cv2.resize((part * per_mm - 0.5).astype(np.float32), None, fx=n, fy=n)[n:-n, n:-n]
        for part in (x, y)
    )
    first = -board.margin_mm * per_mm - 0.5
    last = (size + board.margin_mm) * per_mm - 0.5
    inside = cv2.inRange(x, first, last[0]) & cv2.inRange(y, first, last[1])
    colours = cv2.remap(print_, x, y, cv2.INTER_NEAREST, borderValue=(white,))
    np.copyto(fine[low[1] * n : high[1] * n, low[0] * n : high[0] * n], colours, where=inside > 0)


def _met(view: View, depth: float, u: Indices, v: Indices) -> tuple[Array, Array]:
    """Where rays of pixels meet the board's face at `depth`, board frame, mm."""
    x = (u - (view.width - 1) / 2) / view.focal_px
    y = (v - (view.height - 1) / 2) / view.focal_px
    scale = np.ones_like(x)
    r2 = x * x + y * y
    for _ in range(6):
        scale = 1 / (1 + view.k1 * r2 * scale * scale)
    rays = np.stack([x * scale, y * scale, np.ones_like(x)], axis=-1)
    normal = view.rotation[:, 2]
    origin = view.translation + depth * normal
    distance = (normal @ origin) / (rays @ normal)
    across = (rays * distance[..., None] - origin) @ view.rotation[:, :2]
    return across[..., 0], across[..., 1]


def _print(board: Board, face: int, white: float, black: float) -> tuple[Floats, float]:
    """What is printed on a face, without its margin, and its pixels a square."""
    if board.kind == "checkerboard":
        row, column = np.indices((board.rows, board.columns))
        return np.where((column + row) % 2, white, black).astype(np.float32), 1.0
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    count = board.columns * board.rows // 2
    ids = np.arange(count) + board.first_marker + face * count
    printed = cv2.aruco.CharucoBoard(
        (board.columns, board.rows), board.square_mm, board.marker_mm, dictionary, ids
    )
    printed.setLegacyPattern(board.legacy_layout)
    image = printed.generateImage((board.columns * 100, board.rows * 100))
    return np.where(image > 127, white, black).astype(np.float32), 100.0
