"""A camera as two lookup tables, independent of its lens, for compiled loops."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np

from bodyscan.arrays import Array
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.quadratic_table import QuadraticTable, Table

TOLERANCE_PX = 1e-4
"""A five-hundredth of the precision to which corners and boundaries are found."""
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
        if found.error * px_per_unit < TOLERANCE_PX:
            break
    return found.table
