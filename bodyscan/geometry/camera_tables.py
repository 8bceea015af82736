"""A camera as two lookup tables, independent of its lens, for compiled loops; rays of many pixels;
which points lie in the image."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np

from bodyscan.arrays import Array, Mask
from bodyscan.compiled import compiled
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.quadratic_table import QuadraticTable, Table

CELLS_PX = (32, 16, 8)
"""Cell widths; the widest that keeps the tolerance is used. The first is enough for a scanner's
lens; the last holds one that nearly folds within its image to about 1e-3 px."""
MARGIN_PX = 1.5
"""Extent of the table beyond the outermost pixel centres: outside the table is outside the
image."""
OUTSIDE = -2.0
"""Both values of the projection table where it has none: no pixel has these coordinates."""
CAMERAS = 64  # cached: enough for a few rigs


@lru_cache(CAMERAS)
def projection_table(camera: Camera) -> Table:
    """From ideal normalised (x, y) to the pixel (u, v); OUTSIDE where no ray of the image goes.

    Far outside its image a lens may fold back: such points have no pixel here, although
    `Camera.project` gives them one.
    """
    u, v = (np.linspace(-MARGIN_PX, n - 1.0 + MARGIN_PX, 33) for n in (camera.width, camera.height))
    ideal = camera.rays(np.stack(np.meshgrid(u, v), axis=-1)).reshape(-1, 3)[:, :2]
    fold_radius = camera.lens.fold_radius

    def pixels(normalized: Array) -> Array:
        found = camera.pixels_from_normalized(camera.lens.distort(normalized))
        one_to_one = np.linalg.norm(normalized, axis=-1, keepdims=True) < fold_radius
        return np.where(one_to_one, found, np.nan)

    low, high = np.nanmin(ideal, axis=0), np.nanmax(ideal, axis=0)
    return _within_tolerance(camera, pixels, low, high, 1.0, OUTSIDE)


@lru_cache(CAMERAS)
def ray_table(camera: Camera) -> Table:
    """From a pixel (u, v) of the image to the (x, y) of its ray (x, y, 1); NaN where the lens folds."""
    last = np.array([camera.width, camera.height]) - 0.5

    def ideal(pixels: Array) -> Array:
        return camera.rays(pixels)[..., :2]

    return _within_tolerance(camera, ideal, np.full(2, -0.5), last, camera.alpha, np.nan)


def _within_tolerance(
    camera: Camera,
    function: Callable[[Array], Array],
    low: Array,
    high: Array,
    px_per_unit: float,
    outside: float,
) -> Table:
    for cell in CELLS_PX:
        cells = -(-camera.width // cell), -(-camera.height // cell)
        found = QuadraticTable.fit(function, low, high, cells, outside)
        # A five-hundredth of the precision to which corners and boundaries are found.
        if found.error * px_per_unit < 1e-4:
            break
    return found.table


def look_up_rays(rays: Table, wanted: Mask, first_row: int = 0) -> Array:
    """Rays (N, 3) through the N pixels that are `wanted` (rows, width), row by row.

    rays: the camera's `ray_table`.
    first_row: the image row of the first row of `wanted`.
    """
    found = np.empty((np.count_nonzero(wanted), 3))
    _look_up_rays(rays, first_row, wanted, found)
    return found


@compiled
def _look_up_rays(table: Table, first_row: int, wanted: Mask, rays: Array) -> None:
    """Fill rays (N, 3) of the N pixels `wanted` (rows, width).

    As `look_up`, but within a row each cell's quadratics are reduced to one variable once.
    """
    c, frame = table
    n = 0
    for v in range(wanted.shape[0]):
        down = (first_row + v - frame[1]) * frame[3]
        i, column = int(down), -1
        y = down - i
        x_0 = x_1 = x_2 = y_0 = y_1 = y_2 = 0.0
        for u in range(wanted.shape[1]):
            if wanted[v, u]:
                across = (u - frame[0]) * frame[2]
                j = int(across)
                if j != column:
                    column, x_2, y_2 = j, c[i, j, 0, 5], c[i, j, 1, 5]
                    x_0 = c[i, j, 0, 0] + y * (c[i, j, 0, 1] + y * c[i, j, 0, 2])
                    y_0 = c[i, j, 1, 0] + y * (c[i, j, 1, 1] + y * c[i, j, 1, 2])
                    x_1, y_1 = c[i, j, 0, 3] + y * c[i, j, 0, 4], c[i, j, 1, 3] + y * c[i, j, 1, 4]
                x = across - j
                rays[n, 0], rays[n, 1] = x_0 + x * (x_1 + x * x_2), y_0 + x * (y_1 + x * y_2)
                rays[n, 2] = 1.0
                n += 1


def is_in_image(camera: Camera, points: Array, margin_px: float = 0.0) -> Mask:
    """Whether points (..., 3), camera frame, lie ahead of the camera and inside its image, (...).

    Far outside its image a lens model may fold back, so that points which the camera cannot see
    project inside. They are excluded by the lens's fold radius and by the rays of the image's own
    rim.
    """
    low, high = _reach(camera)
    ahead = points[..., 2] > 0.0
    safe = np.where(ahead[..., None], points, [0.0, 0.0, 1.0])
    ideal = safe[..., :2] / safe[..., 2:3]
    one_to_one = np.linalg.norm(ideal, axis=-1) < camera.lens.fold_radius
    pixels = camera.project(safe)
    last = np.array([camera.width - 1.0, camera.height - 1.0]) - margin_px
    inside = np.all((pixels >= margin_px) & (pixels <= last), axis=-1)
    return ahead & inside & one_to_one & np.all((ideal > low) & (ideal < high), axis=-1)


@lru_cache(CAMERAS)
def _reach(camera: Camera) -> tuple[Array, Array]:
    """Least and greatest ideal (x, y) within the image, with a small margin."""
    u, v = np.linspace(0.0, camera.width - 1.0, 9), np.linspace(0.0, camera.height - 1.0, 9)
    grid = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    rim = camera.rays(grid)[:, :2]
    return np.nanmin(rim, axis=0) - 0.01, np.nanmax(rim, axis=0) + 0.01
