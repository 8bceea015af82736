"""Board corners the chapter's way (sec. 4.1): the crossing of two lines fitted to edges.

"One straight line is fitted to two horizontal line segments and the other straight line is fitted
to two vertical segments. The calibration point is detected as the intersection." `corners` fits
the image of the corner instead, which measures better; this is kept to compare with.
"""

from __future__ import annotations

import cv2
import numpy as np

from bodyscan.arrays import Array, Bytes, Floats

NEAR_PX = 2.5
"""Edges are looked at from here on: nearer, the two lines blur into each other."""

FAR_PX = 10.0
FAR_SQUARES = 0.45
STATIONS = 9
ACROSS_PX = 2.5
ACROSS_SQUARES = 0.3
PROFILE = 21
ROUNDS = 3


def refine_by_lines(image: Bytes, start: Array, along: Array) -> Array:
    """Corners (N, 2) px from starts within about a pixel; NaN where lines cannot be fitted.

    along: (N, 2, 2) px, columns: one square along the print's x, one along its y.
    """
    corner, grey = start.copy(), image.astype(np.float32)
    length = np.linalg.norm(along, axis=1)
    direction = along / length[:, None]
    for _ in range(ROUNDS):
        lines = [_line(grey, corner, direction, length, axis) for axis in (0, 1)]
        corner = _crossing(lines[0], lines[1])
        direction = np.stack([line[1] for line in lines], axis=-1)
    return corner


def _line(
    grey: Floats, corner: Array, direction: Array, length: Array, axis: int
) -> tuple[Array, Array]:
    """A point (N, 2) and direction (N, 2) of the edges on both sides of each corner."""
    tangent = direction[:, :, axis]
    normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=-1)
    slanted = np.abs(np.sum(normal * direction[:, :, 1 - axis], axis=-1))
    far = np.minimum(FAR_PX, FAR_SQUARES * length[:, axis])
    reach = np.minimum(ACROSS_PX, ACROSS_SQUARES * length[:, 1 - axis] * slanted)
    outwards = NEAR_PX + np.linspace(0.0, 1.0, STATIONS) * (far - NEAR_PX)[:, None]
    station = np.concatenate([-outwards, outwards], axis=1)
    offset = np.linspace(-1.0, 1.0, PROFILE) * reach[:, None]
    place = (
        corner[:, None, None]
        + station[:, :, None, None] * tangent[:, None, None]
        + offset[:, None, :, None] * normal[:, None, None]
    )
    edge = _edge_places(grey, place, offset)
    points = (
        corner[:, None] + station[..., None] * tangent[:, None] + edge[..., None] * normal[:, None]
    )
    points[far <= NEAR_PX] = np.nan
    middle = points.mean(axis=1)
    _, _, axes = np.linalg.svd(np.nan_to_num(points - middle[:, None]), full_matrices=False)
    towards = np.sign(np.sum(axes[:, 0] * tangent, axis=-1, keepdims=True))
    return middle, axes[:, 0] * towards


def _edge_places(grey: Floats, place: Array, offset: Array) -> Array:
    """Where along each profile the edge is, (N, stations) px: the centre of its gradient."""
    count = place.shape[0] * place.shape[1]
    sampled = cv2.remap(
        grey, place.reshape(count, PROFILE, 2).astype(np.float32), None, cv2.INTER_CUBIC
    )
    gradient = np.diff(sampled.reshape(place.shape[:3]).astype(np.float64), axis=-1)
    # Noise on the flat ends pulls the centre to the middle; only gradients of the edge's own sign.
    gradient *= np.sign(gradient.sum(axis=-1, keepdims=True))
    gradient = np.maximum(gradient, 0.0)
    between = (offset[:, None, 1:] + offset[:, None, :-1]) / 2
    return (gradient * between).sum(axis=-1) / np.maximum(gradient.sum(axis=-1), 1e-9)


def _crossing(one: tuple[Array, Array], other: tuple[Array, Array]) -> Array:
    """Where lines (point, direction) cross, (N, 2)."""
    matrix = np.stack([one[1], -other[1]], axis=-1)
    determinant = np.linalg.det(matrix)
    matrix[~(np.abs(determinant) > 1e-3)] = np.nan
    apart = other[0] - one[0]
    x = (apart[:, 0] * matrix[:, 1, 1] - apart[:, 1] * matrix[:, 0, 1]) / np.where(
        np.abs(determinant) > 1e-3, determinant, np.nan
    )
    return one[0] + x[:, None] * one[1]
