"""Stripe boundaries on boards of known pose: the points that light sheets are fitted to (Eq. 18)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np

from bodyscan.arrays import Array, Indices, Mask
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.light_planes import Axis
from bodyscan.geometry.transforms import RigidTransform

Height = Callable[[Array], Array]
"""Maps (..., 2) mm of a board to heights (...) mm above its plane."""


@dataclass(frozen=True, eq=False)
class BoundaryPoints:
    """Stripe boundaries of one pair, intersected with its boards, camera frame.

    index: boundary i, where s = i, (N,).
    board: number of the shot, (N,).
    points: (N, 3) mm.
    per_pixel: how a point moves on its board per pixel across the stripe, (N, 3) mm.
    sigma_px: (N,) px.
    """

    index: Indices
    board: Indices
    points: Array
    per_pixel: Array
    sigma_px: Array

    @cached_property
    def board_errors(self) -> BoardErrors:
        """Effects of board errors, from the points themselves, which lie on their boards."""
        return _board_errors(self)


def rays_on_board(
    rays: Array, camera_from_board: RigidTransform, height: Height | None = None
) -> Array:
    """Intersect rays (..., 3), camera frame, with a board's plane z = 0, or with its surface if
    `height` is given; (..., 3) mm (Eq. 18).
    """
    normal = camera_from_board.rotation[:, 2]
    flat = rays * (normal @ camera_from_board.translation / (rays @ normal))[..., None]
    if height is None:
        return flat
    points, board_from_camera = flat, camera_from_board.inverse()
    # One iteration errs by how much the board rises over a few tenths of a millimetre.
    for _ in range(2):
        heights = height(board_from_camera.apply(points)[..., :2])
        points = flat + lift_along_rays(rays, camera_from_board, heights)
    return points


def lift_along_rays(rays: Array, camera_from_board: RigidTransform, height: Array) -> Array:
    """Displacement of points along their rays (..., 3) for a board `height` mm above its plane."""
    return np.asarray(rays * (height / (rays @ camera_from_board.rotation[:, 2]))[..., None])


def boundary_points(
    camera: Camera,
    camera_from_board: RigidTransform,
    index: Indices,
    pixels: Array,
    sigma_px: Array,
    *,
    board: int,
    direction: Axis,
    height: Height | None = None,
) -> BoundaryPoints:
    """Intersect boundary pixels (N, 2) of one shot with its board, flat unless `height` is given."""
    rays, across = camera.rays(pixels), 1 if direction == "horizontal" else 0
    half = np.zeros_like(rays)
    half[:, :2] = 0.5 * camera.rays_by_pixels(rays)[..., across]
    points, after, before = (
        rays_on_board(rays + step, camera_from_board, height) for step in (0.0 * half, half, -half)
    )
    return BoundaryPoints(index, np.full(len(index), board), points, after - before, sigma_px)


def concatenate(parts: Sequence[BoundaryPoints]) -> BoundaryPoints:
    """Join the boundary points of several shots."""
    return BoundaryPoints(
        *(
            np.concatenate([getattr(part, field.name) for part in parts])
            for field in fields(BoundaryPoints)
        )
    )


def select(data: BoundaryPoints, kept: Mask | Indices) -> BoundaryPoints:
    """Select the points where `kept` (N,) is true, or with these indices."""
    return BoundaryPoints(*(getattr(data, field.name)[kept] for field in fields(data)))


def subsample(data: BoundaryPoints, max_points: int) -> BoundaryPoints:
    """Keep about `max_points` points: every n-th boundary, as a whole if at least ten are left.

    A projector with a lens has eleven unknowns, of which one boundary on tilted boards determines
    three; large images have thousands of points a boundary.
    """
    every = -(-len(data.index) // max_points)
    if every <= 1:
        return data
    _, rank = np.unique(data.index, return_inverse=True)
    boundaries = int(rank.max()) + 1
    step = min(every, max(boundaries // 10, 1))
    kept = np.flatnonzero(rank % step == min(step // 2, boundaries - 1))
    return select(data, kept[:: -(-every // step)])


@dataclass(frozen=True, eq=False)
class BoardErrors:
    """How a small error of a board's pose moves its points.

    effects: (N, 3): 1 for the board's shift, and a point's two coordinates on it (of unit variance)
        for its tilts.
    along_ray: (N, 3) mm by which a point moves along its ray per mm of an effect along the normal.
    facing: (N,) |normal . ray|: mm from the board per mm of depth.
    """

    effects: Array
    along_ray: Array
    facing: Array


def _board_errors(data: BoundaryPoints) -> BoardErrors:
    _, board = np.unique(data.board, return_inverse=True)
    count = np.bincount(board)[:, None]
    centred = data.points - (_by_board(data.points, board) / count)[board]
    products = (centred[:, :, None] * centred[:, None]).reshape(-1, 9)
    eigenvalues, axes = np.linalg.eigh(_by_board(products, board).reshape(-1, 3, 3))
    size = np.sqrt(np.maximum(eigenvalues[:, 1:] / count, 1e-18))
    scaled = np.einsum("ni,nij->nj", centred, axes[board][..., 1:]) / size[board]
    outward = np.einsum("ni,ni->n", axes[board][..., 0], data.points)
    return BoardErrors(
        np.column_stack([np.ones(len(scaled)), scaled]),
        data.points / outward[:, None],
        np.abs(outward / data.points[:, 2]),
    )


def _by_board(values: Array, board: Indices) -> Array:
    """Sum values (N, K) over each board's points, (B, K)."""
    return np.stack([np.bincount(board, column) for column in values.T], axis=-1)
