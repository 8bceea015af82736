"""The stripes of one pair on its boards, averaged and intersected with them (Eq. 18): the points that
light sheets are fitted to."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np

from bodyscan.arrays import WHOLE, Array, Crop, Indices, Mask
from bodyscan.boards.view import BoardView
from bodyscan.calibration.board_views import BoardFace, LocatedView
from bodyscan.compiled import compiled
from bodyscan.errors import PairFailed
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.camera_tables import Table, look_up, make_ray_table
from bodyscan.geometry.light_planes import Axis
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.rig.board import Board
from bodyscan.stripes.stripe_code import StripeCode
from bodyscan.stripes.stripe_map import StripeMap

FIT_BINS = 25000
"""Points to which the chosen model is fitted; more do not change it by a tenth of its sigma."""
Height = Callable[[Array], Array]
"""Maps (..., 2) mm of a board to heights (...) mm above its plane."""


@dataclass(frozen=True, eq=False)
class BoundaryPoints:
    """Stripe boundaries of one pair, intersected with its boards, camera frame."""

    index: Indices  # boundary i, where s = i, (N,)
    board: Indices  # number of the shot, (N,)
    points: Array  # (N, 3) mm
    per_pixel: Array  # how a point moves on its board per pixel across the stripe, (N, 3) mm
    sigma_px: Array  # (N,) px

    @cached_property
    def board_errors(self) -> BoardErrors:
        """Effects of board errors, from the points themselves, which lie on their boards."""
        _, board = np.unique(self.board, return_inverse=True)
        count = np.bincount(board)[:, None]
        centred = self.points - (_by_board(self.points, board) / count)[board]
        products = (centred[:, :, None] * centred[:, None]).reshape(-1, 9)
        eigenvalues, axes = np.linalg.eigh(_by_board(products, board).reshape(-1, 3, 3))
        size = np.sqrt(np.maximum(eigenvalues[:, 1:] / count, 1e-18))
        scaled = np.einsum("ni,nij->nj", centred, axes[board][..., 1:]) / size[board]
        # Points on a line show no tilt about it; what is across it is their noise.
        scaled[(size[:, 0] < 0.02 * size[:, 1])[board], 0] = 0.0
        outward = np.einsum("ni,ni->n", axes[board][..., 0], self.points)
        return BoardErrors(
            np.column_stack([np.ones(len(scaled)), scaled]),
            self.points / outward[:, None],
            np.abs(outward / self.points[:, 2]),
        )


def intersect_with_board(
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
        intersect_with_board(rays + step, camera_from_board, height)
        for step in (0.0 * half, half, -half)
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


def _by_board(values: Array, board: Indices) -> Array:
    """Sum values (N, K) over each board's points, (B, K)."""
    return np.stack([np.bincount(board, column) for column in values.T], axis=-1)


BIN_PX = 16
"""Length of a bin along a boundary, which is straight over so short a piece: its sagitta is below a
thousandth of a pixel. Ten times fewer points remain."""
Box = tuple[Array, Array]
"""Smallest and largest (u, v), px."""


@dataclass(frozen=True, eq=False)
class BoardBoundaries:
    """Stripe boundaries of one shot near a board."""

    index: Indices  # (N,)
    pixels: Array  # (N, 2) px
    sigma_px: Array  # (N,) px
    crossing: BoardBoundaries | None = None  # those of the crossing stripes, if there are any


@dataclass(frozen=True, eq=False)
class StripedView:
    """A board that a pair observed, with its pose and the stripes decoded on it."""

    view: LocatedView
    board: Board
    boundaries: BoardBoundaries
    face: BoardFace | None = None  # the face observed, if the board is known not to be flat

    @property
    def camera_from_face(self) -> RigidTransform:
        """Transform from the face observed; its corners lie at z = 0, or near it if not flat."""
        z_mm = self.face.z_mm if self.face else self.view.points[0, 2]
        return self.view.camera_from_board @ RigidTransform.from_translation([0.0, 0.0, z_mm])


def select_boundaries_near(stripes: StripeMap, box: Box, crop: Crop = WHOLE) -> BoardBoundaries:
    """Select the boundaries within a box around a view.

    crop: rows and columns of the image that the stripe map covers.
    """
    low, high = box
    pixels = stripes.boundary_pixels + [crop[1].start or 0, crop[0].start or 0]
    (u, v), (left, top), (right, bottom) = pixels.T, low, high
    near = (u >= left) & (u <= right) & (v >= top) & (v <= bottom)
    return BoardBoundaries(
        stripes.boundary_index[near],
        pixels[near],
        stripes.boundary_sigma_px[near].astype(np.float64),
        select_boundaries_near(stripes.crossing, box, crop)
        if stripes.crossing is not None
        else None,
    )


def crop_around(boxes: Sequence[Box]) -> Crop:
    """Crop the rows and columns that hold all boxes of an image."""
    lows, highs = zip(*boxes, strict=True)
    left, top = np.floor(np.maximum(np.min(lows, axis=0), 0.0)).astype(int)
    right, bottom = np.ceil(np.max(highs, axis=0)).astype(int) + 1
    return slice(int(top), int(bottom)), slice(int(left), int(right))


def compute_box(view: BoardView | LocatedView) -> Box:
    """Compute a box around a view's board, of which some corners may not have been found."""
    low, high = view.pixels.min(axis=0), view.pixels.max(axis=0)
    margin = 0.5 * (high - low)
    return low - margin, high + margin


def compute_print_box(camera: Camera, board: Board, view: LocatedView) -> Box:
    """Compute a box around the print of a board of known pose, within the box around its view."""
    low, high = compute_box(view)
    grid = np.indices((board.columns + 1, board.rows + 1)).reshape(2, -1).T / (
        board.columns,
        board.rows,
    )
    grid = grid * board.size_mm
    on_face = np.column_stack([grid, np.full(len(grid), view.points[0, 2])])
    points = view.camera_from_board.apply(on_face)
    ideal = points[:, :2] / points[:, 2:]
    if np.any(points[:, 2] <= 0.0) or np.hypot(*ideal.T).max() >= camera.lens.fold_radius:
        return low, high
    pixels = camera.project(points)
    # Decoding a boundary uses pixels up to 7 px from it (`usable_pixels`, `albedo_edges`) and
    # boundaries of its run up to 6 px away, which in turn use pixels as far from them.
    margin = 16.0
    return (
        np.maximum(low, pixels.min(axis=0) - margin),
        np.minimum(high, pixels.max(axis=0) + margin),
    )


def thin_bands(
    boundaries: BoardBoundaries, direction: Axis, views: int, turn: int
) -> BoardBoundaries:
    """Keep means of a view in one of so many bands of BIN_PX along the stripes that `views` like it
    have as many as a fit uses.

    turn: number of the view; views take turns. Of each, four bands are left: sheets bow across their
    width.
    """
    along = boundaries.pixels[:, 0 if direction == "horizontal" else 1]
    band = np.floor(along / BIN_PX)
    every = max(min(len(band) * views // FIT_BINS, len(np.unique(band)) // 4), 1)
    kept = band % every == turn % every
    other: Axis = "vertical" if direction == "horizontal" else "horizontal"
    crossing = boundaries.crossing and thin_bands(boundaries.crossing, other, views, turn)
    rest = boundaries.index[kept], boundaries.pixels[kept], boundaries.sigma_px[kept]
    return BoardBoundaries(*rest, crossing)


def locate_boundaries_on_boards(
    name: str, camera: Camera, projector: StripeCode, shots: Sequence[StripedView]
) -> BoundaryPoints:
    """Intersect the boundaries of all shots with their boards; `board` counts the shots.

    Raises PairFailed if fewer than two boards carry stripes.
    """
    parts = [
        on_board(
            camera,
            projector,
            shot.board,
            shot.camera_from_face,
            shot.boundaries,
            number,
            shot.face.height if shot.face else None,
        )
        for number, shot in enumerate(shots)
    ]
    striped = sum(len(part.index) > 0 for part in parts)
    if striped < 2:
        raise PairFailed(
            f"stripes were decoded on {striped} of {len(parts)} board poses, a light plane needs two",
            where=f"pair {name}",
            remedy="capture the stripe sequence on the board in three or more poses",
        )
    return concatenate(parts)


def on_board(
    camera: Camera,
    projector: StripeCode,
    board: Board,
    camera_from_face: RigidTransform,
    boundaries: BoardBoundaries,
    number: int,
    height: Height | None = None,
    *,
    bin_px: int = BIN_PX,
) -> BoundaryPoints:
    """Intersect the boundaries on the board's print with the board, after averaging."""
    means = on_print(camera, projector, board, camera_from_face, boundaries, bin_px)
    return boundary_points(
        camera,
        camera_from_face,
        means.index,
        means.pixels,
        means.sigma_px,
        board=number,
        direction=projector.direction,
        height=height,
    )


def on_print(
    camera: Camera,
    code: StripeCode,
    board: Board,
    camera_from_face: RigidTransform,
    boundaries: BoardBoundaries,
    bin_px: int = BIN_PX,
) -> BoardBoundaries:
    """Average boundaries on the board's checkered area over bin_px pixels along each.

    Stripes on the wall and floor are dropped. Averaging a second time changes nothing.
    """
    # A homography relates a ray to where it meets the board's plane: x ~ [r1 r2 t] (X, Y, 1).
    plane = np.column_stack([camera_from_face.rotation[:, :2], camera_from_face.translation])
    rim = 0.1 * board.square_mm  # next to the print a board may be cut unevenly
    area = np.array(board.size_mm) - rim
    inside = np.zeros(len(boundaries.index), np.bool_)
    pixels = np.ascontiguousarray(boundaries.pixels)
    _mark_inside(make_ray_table(camera), np.linalg.inv(plane), np.append(area, rim), pixels, inside)
    means = bin_boundaries(boundaries, inside, code.direction, bin_px)
    if boundaries.crossing is None or code.crossing is None:
        return means
    across = code.crossing, board, camera_from_face, boundaries.crossing, bin_px
    return replace(means, crossing=on_print(camera, *across))


def bin_boundaries(
    boundaries: BoardBoundaries, kept: Mask, direction: Axis, bin_px: int = BIN_PX
) -> BoardBoundaries:
    """Average the points that are `kept` (N,) over bin_px pixels along each boundary, weighted."""
    index, pixels = boundaries.index[kept], boundaries.pixels[kept]
    if not len(index):
        return BoardBoundaries(index, pixels, boundaries.sigma_px[kept])
    weight = 1.0 / boundaries.sigma_px[kept] ** 2
    along = pixels[:, 0] if direction == "horizontal" else pixels[:, 1]
    cell = np.floor(along / bin_px).astype(np.int64)
    cell -= cell.min()
    pieces = int(cell.max()) + 1
    cell += index * pieces
    total = np.bincount(cell, weight)
    filled = np.flatnonzero(total)
    means = [np.bincount(cell, weight * uv)[filled] / total[filled] for uv in pixels.T]
    return BoardBoundaries(filled // pieces, np.stack(means, axis=1), 1.0 / np.sqrt(total[filled]))


@compiled
def _mark_inside(
    rays: Table, board_from_ray: Array, area: Array, pixels: Array, inside: Mask
) -> None:
    """Set inside (N,) where the rays of pixels (N, 2) meet the board in its checkered area.

    area: (3,) mm; x and y lie between its last entry and its first two.
    """
    h = board_from_ray
    for n in range(len(pixels)):
        x, y = look_up(rays, pixels[n, 0], pixels[n, 1])
        depth = 1.0 / (h[2, 0] * x + h[2, 1] * y + h[2, 2])
        across = depth * (h[0, 0] * x + h[0, 1] * y + h[0, 2])
        down = depth * (h[1, 0] * x + h[1, 1] * y + h[1, 2])
        reached = depth > 0.0 and area[2] < across < area[0] and area[2] < down < area[1]
        inside[n] = reached
