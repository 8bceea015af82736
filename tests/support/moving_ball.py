"""Stripe boundaries as a small pair sees them on a ball that moves while the patterns change."""

from __future__ import annotations

import numpy as np
from ball import ball_depth
from scipy.interpolate import CubicSpline

from bodyscan.arrays import Array, Indices
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses.radial import Radial
from bodyscan.geometry.light_planes import LightPlanes
from bodyscan.stripes.boundaries import Boundaries

CAMERA = Camera(400.0, 402.0, -0.5, 80.0, 60.0, Radial(-0.1, 0.02), 160, 120)
BITS = 7
STRIPES = 1 << BITS
CENTRE, RADIUS = np.array([0.0, 0.0, 900.0]), 260.0
NOISE_PX = 0.02


def sheets() -> LightPlanes:
    """Horizontal stripes from 200 mm above the camera, fanning down over all that it sees."""
    angle = np.radians(np.linspace(4.0, 32.0, STRIPES + 1))
    normals = np.stack([np.zeros_like(angle), np.cos(angle), -np.sin(angle)], axis=1)
    coefficients = np.column_stack([normals, 200.0 * normals[:, 1]])
    return LightPlanes(coefficients, np.zeros((STRIPES + 1, 4, 4)), "horizontal")


def stripe_of(depth: Array) -> Array:
    """(height, width) s: the angle, from the projector, at which light meets the surface there."""
    points = CAMERA.pixel_rays() * depth[..., None]
    angle = np.degrees(np.arctan2(points[..., 1] + 200.0, points[..., 2]))
    return np.asarray((angle - 4.0) * STRIPES / 28.0)


def bit_of(index: Indices) -> Indices:
    """Of Gray code: the finest flips at every other boundary, and so on."""
    return np.asarray(BITS - 1 - np.log2(index & -index).astype(np.int64))


def seen_boundaries(
    velocity: Array, times: Array, *, seed: int | None = 1, beside: Array | None = None
) -> Boundaries:
    """Where pattern and inverse of each bit, taken at times (BITS,), have the boundaries of a ball that
    is at CENTRE at time 0; noise of NOISE_PX unless seed is None.

    beside: (height, width) mm by which the depth grows per unit of time besides.
    """
    beside = np.zeros((CAMERA.height, CAMERA.width)) if beside is None else beside
    found = []
    for bit, time in enumerate(times):
        s = stripe_of(ball_depth(CAMERA, CENTRE + time * velocity, RADIUS) + time * beside)
        for column in range(CAMERA.width):
            rows = np.flatnonzero(np.isfinite(s[:, column]))
            if len(rows) < 20:
                continue
            first, last = np.ceil(s[rows[0], column]), np.floor(s[rows[-1], column])
            index = np.arange(int(first), int(last) + 1)
            index = index[bit_of(index) == bit]
            rows_at = CubicSpline(s[rows, column], rows.astype(float))(index)
            found.append(np.column_stack([np.full(len(index), column), index, rows_at]))
    line, number, position = np.concatenate(found).T
    order = np.lexsort([number, line])
    line, number, position = line[order].astype(int), number[order].astype(int), position[order]
    if seed is not None:
        position = position + NOISE_PX * np.random.default_rng(seed).standard_normal(len(position))
    return Boundaries(
        line=line,
        before=np.floor(position).astype(int),
        position=position,
        line_position=line.astype(float),
        sigma_px=np.full(len(line), NOISE_PX),
        index=number,
        joined=(np.diff(line) == 0) & (np.diff(number) == 1),
        blur2=0.36,
    )
