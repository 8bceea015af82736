"""Stripe boundaries of the simulator's own mirror on boards of known place, without any image."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Sequence
from functools import cache

import numpy as np

from bodyscan.arrays import Array, Indices
from bodyscan.calibration.boundary_points import BoundaryPoints, boundary_points, concatenate
from bodyscan.geometry.camera import camera_from_fields
from bodyscan.geometry.light_planes import LightPlanes
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.laboratory import apparatus
from bodyscan.simulation.files import describe_camera

LENS = camera_from_fields(describe_camera(apparatus.CAMERA))
MIRROR = apparatus.chapter_setup(apparatus.ideal_settings(1)).projector
STRIPES = apparatus.PROJECTOR.stripes


@cache
def _seen_of_the_mirror(place: bytes, every_px: int) -> tuple[Indices, Array]:
    return seen_on(pickle.loads(place), MIRROR.stripe, every_px=every_px)


def seen_on(
    place: RigidTransform, stripe: Callable[[Array], Array], *, every_px: int = 8
) -> tuple[Indices, Array]:
    """Boundaries (N,) and the pixels (N, 2) at which image lines meet them on a board."""
    normal = place.rotation[:, 2]

    def s_at(pixels: Array) -> tuple[Array, Array]:
        rays = apparatus.CAMERA.directions(pixels)
        points = rays * (normal @ place.translation / (rays @ normal))[:, None]
        return stripe(points), points

    index, v = (
        grid.ravel()
        for grid in np.meshgrid(np.arange(STRIPES + 1), np.arange(0.0, 480.0, every_px))
    )
    pixels = np.column_stack([np.full(len(v), 320.0), v])
    for _ in range(12):
        s, _ = s_at(pixels)
        slope = (s_at(pixels + [0.5, 0.0])[0] - s) / 0.5
        pixels[:, 0] -= np.clip((s - index) / slope, -80.0, 80.0)
    s, points = s_at(pixels)
    x, y, _ = place.inverse().apply(points).T
    width, height = (
        apparatus.BOARD.columns * apparatus.BOARD.square_mm,
        apparatus.BOARD.rows * apparatus.BOARD.square_mm,
    )
    on = (x > 0) & (x < width) & (y > 0) & (y < height) & (np.abs(s - index) < 1e-7)
    return index[on], pixels[on]


def mirror_points(
    places: Sequence[RigidTransform] | None = None,
    *,
    stripe: Callable[[Array], Array] = MIRROR.stripe,
    noise_px: float = 0.0,
    every_px: int = 8,
) -> BoundaryPoints:
    """On the chapter's three boards, as a perfect calibration of the camera has them."""
    rng = np.random.default_rng(0)
    parts = []
    for number, place in enumerate(places or apparatus.board_poses()):
        if stripe == MIRROR.stripe:  # asked for again with every draw of noise
            index, exact = _seen_of_the_mirror(pickle.dumps(place), every_px)
        else:
            index, exact = seen_on(place, stripe, every_px=every_px)
        pixels = exact + noise_px * rng.standard_normal((len(exact), 1)) * [1.0, 0.0]
        sigma = np.full(len(index), max(noise_px, 0.01))
        parts.append(
            boundary_points(LENS, place, index, pixels, sigma, board=number, direction="vertical")
        )
    return concatenate(parts)


def systematic_mm(planes: LightPlanes, *, spread_mm: float = 60.0) -> float:
    """RMS depth error over a wall at 400 mm, every stripe coordinate known exactly."""
    x, y = np.meshgrid(np.linspace(-spread_mm, spread_mm, 40), np.linspace(-50.0, 40.0, 30))
    points = np.stack([x, y, np.full_like(x, 400.0)], axis=-1).reshape(-1, 3)
    depth = planes.intersect(points / points[:, 2:], MIRROR.stripe(points)).depth
    return float(np.sqrt(np.nanmean((depth - 400.0) ** 2)))
