"""Signed distances of a closed surface on a coarse grid, filled in where nothing was measured.

Near the cloud its points determine them. Elsewhere they are harmonic, each the mean of its
neighbours, which continues the surface from rim to rim. But what cameras saw through is outside,
and so is what lies below the floor, or above the tangent planes of a crown: a first guess spans
gaps and bulges over crowns by millimetres, and these bounds correct it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label, maximum_filter

from bodyscan.arrays import Array, Floats, Indices, Mask
from bodyscan.compiled import compiled
from bodyscan.fusion.regions import DARK
from bodyscan.fusion.signed_distances import REACH_CELLS, Distances, splat_planes
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.mesh.body import BodyCloud
from bodyscan.mesh.depth_buffer import find_nearest_faces
from bodyscan.mesh.surface_nets import SIDE, Bricks, extract_surface, join_bricks, split_into_bricks
from bodyscan.progress import map_threads
from bodyscan.reconstruction.range_image import RangeImage

CELL_MM = 7.0
"""Cell of the coarse grid: half a finger, so that the filled surface follows the rims."""
RELAXATION_SWEEPS = 16

Values = TypeVar("Values", Floats, Mask)


def fill_distances(
    cloud: BodyCloud,
    finest_mm: float,
    range_images: Sequence[RangeImage],
    rig_from_camera: dict[str, RigidTransform],
) -> Distances:
    """Signed distances of a closed surface through the cloud, on a grid with room around it, no
    cell smaller than `finest_mm`; range_images: as measured, background included."""
    cell_mm = max(CELL_MM, finest_mm)
    bricks = _make_grid_around(cloud.points, cell_mm)
    some = cloud.subsample(max(1, len(cloud.points) // 250_000))  # nine within a node's reach
    # From a rim the surface continues straight for a cell before it bends.
    reach_cells = max(10.0 / cell_mm, REACH_CELLS)
    splatted = splat_planes(some, bricks, reach_cells)
    values, weights = (join_bricks(part, bricks.table.shape) for part in splatted)
    reach = reach_cells * cell_mm
    fixed = weights > 0.05  # one point 7 mm away
    values = np.clip(values, -reach, reach)
    for axis in range(3):
        np.moveaxis(values, axis, 0)[[0, -1]] = 0.3 * reach  # small, or missing parts cave in
        np.moveaxis(fixed, axis, 0)[[0, -1]] = True
    height = (bricks.origin[2] + cell_mm * np.arange(values.shape[2])).astype(np.float32)
    below = int(np.count_nonzero(height < 0.0))
    measured = fixed.copy()
    for part in (values, fixed):
        _mirror(part, below, ~measured)
    bound = np.full(values.shape, -np.inf, np.float32)
    certain = 0.75 * reach  # so far from the surface a coarser grid has the side right
    guess = np.maximum(fill_harmonically(values, fixed, bound, certain), -height)
    dark, grey = np.zeros(values.shape, bool), cloud.grey
    points = cloud.points[grey < DARK * np.median(grey)]
    dark[tuple(np.rint((points - bricks.origin) / cell_mm).astype(int).T)] = True
    dark = _dilate(dark, 2)
    free = _find_free_nodes(guess, measured, dark, bricks, range_images, rig_from_camera)
    bound[free] = 0.5 * cell_mm
    if free.any():
        _mirror(bound, below, ~measured)
        guess = np.maximum(fill_harmonically(values, fixed, bound, certain), -height)
    crown = Crown.from_cloud(cloud.points, cloud.normals)
    layer = np.searchsorted(height, crown.lowest_mm)
    node = np.argwhere(~measured[..., layer:] & (guess[..., layer:] < cell_mm)) + [0, 0, layer]
    above, at = crown.compute_heights_above(bricks.origin + cell_mm * node), tuple(node.T)
    guess[at] = np.maximum(guess[at], above - Crown.NOISE_MM)
    return Distances(guess, bricks.origin, cell_mm)


def _mirror(values: Floats | Mask, below: int, where: Mask) -> None:
    """Mirror nodes from above the floor to below it where `where` is true: filled surface then
    meets the floor upright."""
    count = min(below, values.shape[2] - below)
    if count > 0:
        under = np.s_[..., below - count : below]
        above = values[..., below : below + count][..., ::-1]
        values[under] = np.where(where[under], above, values[under])


def _make_grid_around(points: Array, cell_mm: float) -> Bricks:
    """All bricks around the points; the floor, z = 0, lies between two layers of nodes."""
    # As far as a harmonic surface bulges, and more than a point's reach and the neighbouring cells.
    room = max(60.0, 5 * cell_mm)
    origin = (np.floor((points.min(axis=0) - room) / cell_mm) - 0.5) * cell_mm
    shape = np.ceil(((points.max(axis=0) + room - origin) / cell_mm + 1.0) / SIDE).astype(int)
    return Bricks.from_mask(np.ones(shape, bool), origin, cell_mm)


def _find_free_nodes(
    guess: Floats,
    fixed: Mask,
    dark: Mask,
    bricks: Bricks,
    range_images: Sequence[RangeImage],
    rig_from_camera: dict[str, RigidTransform],
) -> Mask:
    """Find nodes (a, b, c) inside a guessed surface, off the cloud, that cameras saw through."""
    free = np.zeros(guess.shape, bool)
    if not range_images:
        return free
    vertices, faces = extract_surface(bricks, split_into_bricks(guess))
    nearest = np.rint((vertices - bricks.origin) / bricks.cell_mm).astype(int)
    filled, near_dark = ~fixed[tuple(nearest.T)], dark[tuple(nearest.T)]
    surface = PartialSurface(
        vertices.astype(np.float32), faces, filled[faces].any(axis=1), near_dark[faces].any(axis=1)
    )
    index = np.argwhere((guess < 0.0) & ~fixed)
    nodes = (bricks.origin + bricks.cell_mm * index).astype(np.float32)
    votes = map_threads(
        lambda image: find_free_points(nodes, surface, image, rig_from_camera[image.pair]),
        range_images,
    )
    free[tuple(index[np.logical_or.reduce(votes)].T)] = True
    return free


def fill_harmonically(values: Floats, fixed: Mask, bound: Floats, certain: float) -> Floats:
    """Fill in the values (a, b, c) that are not fixed; the grid's rim must be fixed.

    bound: lower bounds (a, b, c) of nodes that are not fixed; -inf for none.
    certain: nodes that a coarser grid puts farther from 0 keep its value, and so do those far from
        any change of sign and from any active bound, since only the zero set matters.

    Multigrid: solved first on grids two, four and eight times as coarse.
    """
    if min(values.shape) <= 16 or any(size % 2 for size in values.shape):
        found, sweeps = np.where(fixed, values, np.maximum(np.float32(0.0), bound)), 200
        free = ~fixed
    else:
        coarse = fill_harmonically(*_coarsen(values, fixed, bound), certain)
        # Within two nodes of both signs: a coarser zero set is off by less than one.
        guess, near = _refine(coarse), _dilate(coarse < 0.0, 2) & _dilate(coarse >= 0.0, 2)
        found, sweeps = np.where(fixed, values, np.maximum(guess, bound)), RELAXATION_SWEEPS
        active = ~fixed & (bound > guess)
        if active.any():  # a gap is narrow: of the eight nodes of a coarser one not all have bounds
            # Sweeps carry a bound that the coarser grid lacks by half as many nodes.
            near |= _dilate(_sum_eight(active), RELAXATION_SWEEPS // 2)
        free = ~fixed & _refine(near) & (np.abs(found) < certain)
    found = np.ascontiguousarray(found, np.float32)
    nodes = np.flatnonzero(free).astype(np.int32)
    _relax(found.ravel(), nodes, found.shape[1:], bound.ravel(), sweeps)
    return found


def _coarsen(values: Floats, fixed: Mask, bound: Floats) -> tuple[Floats, Mask, Floats]:
    """One node for eight: the mean of the fixed ones, and of the bounds if all have one."""
    count = _sum_eight(fixed.astype(np.float32))
    known = _sum_eight(np.where(fixed, values, np.float32(0.0)))
    known /= np.maximum(count, np.float32(1.0))
    return np.asarray(known, np.float32), count > 0, _sum_eight(0.125 * bound)


def _sum_eight(part: Values) -> Values:
    """Sums (or, of masks, any) over 2 x 2 x 2 nodes; several times faster axis by axis."""
    part = part[::2] + part[1::2]
    part = part[:, ::2] + part[:, 1::2]
    return part[:, :, ::2] + part[:, :, 1::2]


def _dilate(where: Mask, nodes: int) -> Mask:
    """`where`, and the nodes at most so many away along each axis."""
    return np.asarray(maximum_filter(where, 2 * nodes + 1, mode="constant"))


def _refine(coarse: Values) -> Values:
    return coarse.repeat(2, axis=0).repeat(2, axis=1).repeat(2, axis=2)


@compiled
def _relax(
    values: Floats, nodes: NDArray[np.int32], shape: tuple[int, ...], bound: Floats, sweeps: int
) -> None:
    """Gauss-Seidel sweeps over some nodes, in alternating order, with successive over-relaxation."""
    a, b = shape[0] * shape[1], shape[1]
    keep, share = np.float32(1.0 - 1.6), np.float32(1.6 / 6.0)
    for sweep in range(sweeps):
        step = 1 if sweep % 2 == 0 else -1
        for n in range(len(nodes)):
            at = nodes[n if step > 0 else len(nodes) - 1 - n]
            others = values[at - a] + values[at + a] + values[at - b] + values[at + b]
            new = keep * values[at] + share * (others + values[at + step])
            new += share * values[at - step]  # last: it was computed just now, still in flight
            values[at] = max(new, bound[at])


RAY_SPACING_MM = 3.0
"""Between rays that look through gaps, at the subject."""
CROWN_RADIUS_MM = 100.0
"""Half the length of a head: what lies farther from its highest point is not part of it."""


@dataclass(frozen=True, eq=False)
class PartialSurface:
    """A closed surface, partly filled: vertices (V, 3) float32, rig frame; faces (F, 3); filled and
    dark (F,), dark ones near dark cloth or hair, next to which a lack of points proves nothing."""

    vertices: Floats
    faces: Indices
    filled: Mask
    dark: Mask


def find_free_points(
    points: Floats, surface: PartialSurface, image: RangeImage, rig_from_camera: RigidTransform
) -> Mask:
    """Find the points (N, 3), rig frame, that one camera saw through by at least 10 mm: something
    was measured behind them, or they lie in a gap (see `find_gaps`)."""
    in_camera = rig_from_camera.inverse().apply(points.astype(np.float64))
    ahead = in_camera[:, 2] > 1.0
    u, v = image.camera.project(np.where(ahead[:, None], in_camera, 1.0)).T
    columns, rows = np.rint(u).astype(np.intp), np.rint(v).astype(np.intp)
    inside = ahead & (columns >= 0) & (columns < image.camera.width)
    inside &= (rows >= 0) & (rows < image.camera.height)
    index = np.flatnonzero(inside)
    through = np.zeros(len(points), bool)
    if not index.size:
        return through
    columns, rows = columns[index], rows[index]
    # The nearest depth around, 0 if anything is missing: rims and flying pixels prove nothing.
    nearest = cv2.erode(image.open_depth, np.ones((5, 5), np.uint8))
    through[index] = in_camera[index, 2] < nearest[rows, columns] - 10.0
    depth_mm = float(np.median(in_camera[index, 2]))
    stride = max(1, round(RAY_SPACING_MM * image.camera.alpha / depth_mm))
    block_rows, block_columns = rows // stride, columns // stride
    top, left = block_rows.min(), block_columns.min()
    blocks = slice(top, block_rows.max() + 1), slice(left, block_columns.max() + 1)
    open_ = find_gaps(surface, image, rig_from_camera, stride, blocks)
    through[index] |= open_[block_rows - top, block_columns - left]
    return through


def find_gaps(
    surface: PartialSurface,
    image: RangeImage,
    rig_from_camera: RigidTransform,
    stride: int,
    blocks: tuple[slice, slice],
) -> Mask:
    """Find the blocks of stride x stride pixels in a window that look through a gap of the body.

    In such a block nothing was measured, its middle shows only filled faces, and the nearest measured
    surfaces to the left and to the right are not dark, turn towards it and run into what fills it:
    between the legs, between arm and trunk. A filled face in front of or behind measured surface is a
    part in shadow instead, and so is one between surfaces that turn away from each other, as round a
    thigh, or that begins behind one of them: a hand, and its shadow on a thigh.
    """
    rows, columns = (stride * np.arange(some.start, some.stop) + stride // 2 for some in blocks)
    vertices = _project_to_blocks(surface.vertices, image, rig_from_camera, stride, blocks)
    first = find_nearest_faces(vertices, surface.faces, len(rows), len(columns))
    hit = first >= 0
    filled = np.zeros(hit.shape, bool)
    filled[hit] = surface.filled[first[hit]]
    body = hit & ~filled
    depth = np.where(hit, vertices[surface.faces[first], 2].mean(axis=-1), np.nan)
    bright, rightward = np.zeros(hit.shape, bool), np.zeros(hit.shape)
    bright[body] = ~surface.dark[first[body]]
    corners = surface.vertices[surface.faces[first[body]]].astype(np.float64)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    rightward[body] = normals @ rig_from_camera.rotation[:, 0]
    # A coarse face at a rim has any direction: the mean over 15 mm.
    rightward = cv2.blur(rightward, (5, 5)) / np.maximum(cv2.blur(body.astype(float), (5, 5)), 0.01)
    near = np.ones((2 * stride + 1, 2 * stride + 1), np.uint8)
    measured = np.pad(cv2.dilate((image.open_depth > 0).astype(np.uint8), near), stride)
    reach = int(200.0 / RAY_SPACING_MM)  # the widest gap
    open_ = filled & (measured[np.ix_(rows + stride, columns + stride)] == 0)
    left, turn_left = _find_left_neighbour(body, bright, rightward, depth, reach)
    mirrored = body[:, ::-1], bright[:, ::-1], rightward[:, ::-1], depth[:, ::-1]
    right, turn_right = _find_left_neighbour(*mirrored, reach)
    # Of flat surfaces the difference is 0, round a finger -0.2.
    open_ &= left & right[:, ::-1] & (turn_left - turn_right[:, ::-1] > -0.1)
    real = find_nearest_faces(vertices, surface.faces[~surface.filled], len(rows), len(columns))
    # Between two fingers a patch of shadow shows, and not what is behind the body: less than 200 mm2.
    number, count = label(open_ & (real < 0), np.ones((3, 3)))
    large = np.bincount(number.ravel(), minlength=count + 1) * RAY_SPACING_MM**2 > 200.0
    return np.asarray(large[number] & (number > 0))


def _project_to_blocks(
    vertices: Floats,
    image: RangeImage,
    rig_from_camera: RigidTransform,
    stride: int,
    blocks: tuple[slice, slice],
) -> Floats:
    """(V, 3): column and row of the block that shows each vertex, and depth; NaN behind the
    camera."""
    points = rig_from_camera.inverse().apply(vertices.astype(np.float64))
    points[points[:, 2] < 1.0] = np.nan
    pixels = (image.camera.project(points) - stride // 2) / stride
    first = blocks[1].start, blocks[0].start
    return np.concatenate([pixels - first, points[:, 2:]], axis=1).astype(np.float32)


def _find_left_neighbour(
    body: Mask, bright: Mask, values: Array, depth: Array, reach: int
) -> tuple[Mask, Array]:
    """Whether the nearest pixel of the body to the left in the same row is bright, at most `reach` away
    and not far before its right neighbour, and its value."""
    joined = bright.copy()
    # What is half a wrist before a surface hides it, and does not run into it.
    joined[:, :-1] &= ~(np.diff(depth, axis=1) > 30.0)
    columns = np.arange(body.shape[1])
    latest = np.maximum.accumulate(np.where(body, columns, -reach - 1), axis=1)
    at = latest.clip(0)
    near = (columns - latest <= reach) & np.take_along_axis(joined, at, axis=1)
    return near, np.take_along_axis(values, at, axis=1)


@dataclass(frozen=True, eq=False)
class Crown:
    """Tangent planes below which everything measured around the top of a head lies.

    A crown is convex: where cameras see its top too flat to measure it, these planes bound the
    head's height to a millimetre; planes around a hairline are steep and bound nothing.
    """

    highest: Array  # the highest point measured, (3,) mm
    # normals, offsets: of the planes, (P, 3) and (P,) mm.
    normals: Array
    offsets: Array

    NOISE_MM: ClassVar[float] = 0.5
    """A plane that measured points exceed by more is no bound: the body is not convex there."""

    @staticmethod
    def from_cloud(points: Array, normals: Array | Floats) -> Crown:
        """The crown of a body's points (N, 3), z up, with normals (N, 3)."""
        highest = points[np.argmax(points[:, 2])]
        near = points[:, 2] > highest[2] - 60.0  # ears begin lower
        near &= np.hypot(*(points[:, :2] - highest[:2]).T) < CROWN_RADIUS_MM
        position, normal = points[near], normals[near].astype(np.float64)
        # A crown bends by 0.1 mm over half a cell of 8 mm.
        cell = np.floor(position / 8.0).astype(np.int64)
        _, number, count = np.unique(cell, axis=0, return_inverse=True, return_counts=True)

        def mean(values: Array) -> Array:
            sums = [np.bincount(number.ravel(), column) for column in values.T]
            return np.asarray(np.stack(sums, axis=1) / count[:, None])

        position, normal = mean(position), mean(normal)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
        offsets = np.sum(position * normal, axis=1)
        above = np.max(normal @ position.T - offsets[:, None], axis=1, initial=0.0)
        bounds = (above < Crown.NOISE_MM) & (normal[:, 2] > 0.5)
        return Crown(highest, normal[bounds], offsets[bounds])

    @property
    def unknown_mm(self) -> float:
        """By how much the head may end higher than was measured; inf if nothing bounds it: the
        highest point below all planes, a linear program."""
        from scipy.optimize import linprog  # imported here because not every scan needs it

        if not len(self.offsets):
            return np.inf
        room = [(-CROWN_RADIUS_MM, CROWN_RADIUS_MM)] * 2 + [(0.0, None)]
        above = self.offsets - self.normals @ self.highest
        found = linprog([0.0, 0.0, -1.0], A_ub=self.normals, b_ub=above, bounds=room)
        return 0.0 if found.x is None else float(found.x[2])

    @property
    def lowest_mm(self) -> float:
        """Height from which on the planes bound the head."""
        return float(self.highest[2]) - 60.0 / 3.0

    def compute_heights_above(self, points: Array) -> Array:
        """Height (N,) mm of points (N, 3) at the top of the head above its planes; -inf elsewhere."""
        near = points[:, 2] > self.lowest_mm
        near &= np.hypot(*(points[:, :2] - self.highest[:2]).T) < CROWN_RADIUS_MM
        above = np.full(len(points), -np.inf)
        above[near] = np.max(points[near] @ self.normals.T - self.offsets, axis=1, initial=-np.inf)
        return above
