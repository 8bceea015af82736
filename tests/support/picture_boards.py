"""Boards in all parts of one camera's picture: corners with noise, no images."""

from __future__ import annotations

import numpy as np

from bodyscan.calibration.board_views import PlanarView
from bodyscan.calibration.lens_selection import ChosenLens, calibrate_widest, choose_lens
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses import FAMILY
from bodyscan.geometry.lenses.lens import Lens
from bodyscan.geometry.transforms import RigidTransform

WIDTH, HEIGHT, FOCAL = 1280, 1024, 800.0
NOISE_PX = 0.05
POINTS = np.array([[24.0 * x, 24.0 * y, 0.0] for y in range(10) for x in range(7)])
MIDDLE = np.array([72.0, 108.0, 0.0])


def seen(
    lens: Lens,
    *,
    shots: int = 12,
    seed: int = 0,
    again: int = 1,
    focal: float = FOCAL,
    reach: float = 1.0,
) -> list[PlanarView]:
    """Boards all over the picture, or that part of it, each `again` times in the same place."""
    rng, widen = np.random.default_rng(seed), reach * FOCAL / focal
    camera = Camera(focal, focal + 1.0, -0.5, 645.0, 508.0, lens, WIDTH, HEIGHT)
    views: list[PlanarView] = []
    while len(views) < shots * again:
        tilt = RigidTransform.from_rotation_vector(rng.normal(0.0, 0.35, 3), np.zeros(3))
        depth = rng.uniform(350.0, 600.0)
        where = depth * np.array([*widen * rng.uniform([-0.5, -0.35], [0.5, 0.35]), 1.0])
        placed = RigidTransform(tilt.rotation, where - tilt.rotation @ MIDDLE).apply(POINTS)
        pixels = camera.project(placed)
        inside = np.all((pixels > 3.0) & (pixels < [WIDTH - 4.0, HEIGHT - 4.0]), axis=1)
        inside &= np.linalg.norm(placed[:, :2] / placed[:, 2:], axis=1) < lens.fold_radius
        if inside.sum() < 30:
            continue
        for _ in range(again):
            noisy = pixels[inside] + rng.normal(0.0, NOISE_PX, (inside.sum(), 2))
            views.append(PlanarView(f"s{len(views)}", POINTS[inside], noisy))
    return views


def calibrate_with_lenses(views: list[PlanarView]) -> ChosenLens:
    """A camera with the lens that its held-out boards choose."""
    start = calibrate_widest(FAMILY, views, WIDTH, HEIGHT)
    return choose_lens(FAMILY, start.camera, start.poses, views)
