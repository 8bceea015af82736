"""Likely signed distances to the surface, on a coarse grid that leaves no node out.

Near the cloud its points determine them. Elsewhere distances are filled in harmonically, which
continues the surface from rim to rim. But what cameras saw through is outside, and so is what lies
below the floor, or above the tangent planes of a crown: a first guess spans gaps and bulges over
crowns by millimetres, and these bounds correct it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bodyscan.arrays import Array, Floats, Mask
from bodyscan.compiled import compiled
from bodyscan.fusion.crown import NOISE_MM, Crown
from bodyscan.fusion.free_space import Guess, sees_through
from bodyscan.fusion.harmonic_filling import fill_harmonically
from bodyscan.fusion.signed_distances import REACH_CELLS, splat
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.mesh.body import BodyCloud
from bodyscan.mesh.surface_nets import SIDE, Bricks, extract_surface, join_bricks, split_into_bricks
from bodyscan.progress import map_threads
from bodyscan.reconstruction.range_image import RangeImage

CELL_MM = 7.0  # of the coarse grid: half a finger, so that the filled surface follows the rims
ROOM_MM = 60.0  # around the cloud: as far as a harmonic surface bulges where nothing was measured
REACH_MM = 10.0  # of a point: from a rim the surface continues straight for a cell before it bends
FEWEST_CELLS = 5  # of room: more than a point's reach and the neighbouring cells
ENOUGH_POINTS = 250_000  # for the coarse grid: nine within reach of a node
KNOWN_WEIGHT = 0.05  # of a node: one point 7 mm away
RIM = 0.3  # of the reach, at the grid's rim: small, or missing parts would cave in
SURE = 0.75  # of the reach: this far from the surface a coarser grid has the side right
MARGIN_MM = 10.0  # a camera sees through a place if what it measured is this much farther away


@dataclass(frozen=True, eq=False)
class Distances:
    """Signed distances at all nodes of a grid, negative inside.

    values: (a, b, c) mm.
    origin: the first node, (3,) mm.
    cell_mm: from node to node.
    """

    values: Floats
    origin: Array
    cell_mm: float


def likely_distances(
    cloud: BodyCloud,
    finest_mm: float,
    range_images: Sequence[RangeImage],
    rig_from_camera: dict[str, RigidTransform],
    *,
    workers: int,
) -> Distances:
    """Signed distances of a closed surface through the cloud, on a grid with room around it.

    finest_mm: no cell is smaller.
    range_images: as measured, background included.
    """
    cell_mm = max(CELL_MM, finest_mm)
    bricks = _grid_around(cloud.points, cell_mm)
    some = cloud.subsample(max(1, len(cloud.points) // ENOUGH_POINTS))
    reach_cells = max(REACH_MM / cell_mm, REACH_CELLS)
    splatted = splat(some, bricks, reach_cells)
    values, weights = (join_bricks(part, bricks.table.shape) for part in splatted)
    reach = reach_cells * cell_mm
    fixed = weights > KNOWN_WEIGHT
    values = np.clip(values, -reach, reach)
    for axis in range(3):
        for side in (0, -1):
            np.moveaxis(values, axis, 0)[side] = RIM * reach
            np.moveaxis(fixed, axis, 0)[side] = True
    height = (bricks.origin[2] + cell_mm * np.arange(values.shape[2])).astype(np.float32)
    below = int(np.count_nonzero(height < 0.0))
    measured = fixed.copy()
    for part in (values, fixed):
        _mirror(part, below, ~measured)
    least = np.full(values.shape, -np.inf, np.float32)
    guess = np.maximum(fill_harmonically(values, fixed, least, SURE * reach), -height)
    free = _seen_through(guess, measured, bricks, range_images, rig_from_camera, workers)
    least[free] = 0.5 * cell_mm
    _hold_crown(least, guess, measured, bricks, Crown.from_cloud(cloud.points, cloud.normals))
    if np.isfinite(least).any():
        _mirror(least, below, ~measured)
        guess = np.maximum(fill_harmonically(values, fixed, least, SURE * reach), -height)
    return Distances(guess, bricks.origin, cell_mm)


def _hold_crown(least: Floats, guess: Floats, measured: Mask, bricks: Bricks, crown: Crown) -> None:
    """Bound the nodes around which the guessed surface stands above a crown's planes."""
    inside, cell_mm = guess < 0.0, bricks.cell_mm
    ends = inside[..., :-1] & ~inside[..., 1:] & ~(measured[..., :-1] & measured[..., 1:])
    node = np.argwhere(ends)
    below, above = guess[..., :-1][ends], guess[..., 1:][ends]
    low = bricks.origin + cell_mm * node
    up = np.array([0.0, 0.0, cell_mm])
    crossing = low + up * (below / np.minimum(below - above, -1e-6))[:, None]
    bulges = crown.outside(crossing) > NOISE_MM
    for places, at in ((low, node), (low + up, node + [0, 0, 1])):
        chosen = tuple(at[bulges].T)
        over = crown.outside(places[bulges])
        least[chosen] = np.where(over > 0.0, np.maximum(over, least[chosen]), least[chosen])


def _mirror(values: Floats | Mask, below: int, where: Mask) -> None:
    """Mirror nodes from above the floor to below it, where `where` is true.

    What is filled in between then meets the floor upright: nobody sees the soles, but they stand on
        it.
    """
    count = min(below, values.shape[2] - below)
    if count > 0:
        under = np.s_[..., below - count : below]
        above = values[..., below : below + count][..., ::-1]
        values[under] = np.where(where[under], above, values[under])


def _grid_around(points: Array, cell_mm: float) -> Bricks:
    """All bricks around the points; the floor, z = 0, lies between two layers of nodes."""
    room = max(ROOM_MM, FEWEST_CELLS * cell_mm)
    origin = (np.floor((points.min(axis=0) - room) / cell_mm) - 0.5) * cell_mm
    shape = np.ceil(((points.max(axis=0) + room - origin) / cell_mm + 1.0) / SIDE).astype(int)
    return Bricks.from_mask(np.ones(shape, bool), origin, cell_mm)


def _seen_through(
    guess: Floats,
    fixed: Mask,
    bricks: Bricks,
    range_images: Sequence[RangeImage],
    rig_from_camera: dict[str, RigidTransform],
    workers: int,
) -> Mask:
    """Nodes (a, b, c) inside a guessed surface, away from the cloud, that cameras saw through."""
    free = np.zeros(guess.shape, bool)
    if not range_images:
        return free
    vertices, faces = extract_surface(bricks, split_into_bricks(guess))
    nearest = np.rint((vertices - bricks.origin) / bricks.cell_mm).astype(int)
    made_up = ~fixed[tuple(nearest.T)]
    surface = Guess.of(vertices, faces, made_up[faces].any(axis=1))
    index = np.argwhere((guess < 0.0) & ~fixed)
    places = (bricks.origin + bricks.cell_mm * index).astype(np.float32)
    votes = map_threads(
        lambda image: sees_through(places, surface, image, rig_from_camera[image.pair], MARGIN_MM),
        range_images,
        stage="free space",
        workers=workers,
    )
    free[tuple(index[np.logical_or.reduce(votes)].T)] = True
    return free


def crossed(distances: Distances, cell_mm: float, shape: tuple[int, ...]) -> Mask:
    """Which bricks (a, b, c) of a finer grid with the same origin the surface passes through."""
    wanted = np.zeros(shape, np.bool_)
    _find_crossed(distances.values, cell_mm / distances.cell_mm, wanted)
    return wanted


def interpolated(distances: Distances, bricks: Bricks) -> Floats:
    """Distances at the nodes of a finer grid with the same origin."""
    found = np.empty(bricks.shape, np.float32)
    _interpolate(distances.values, bricks.cell_mm / distances.cell_mm, bricks.indices, found)
    return found


@compiled
def _find_crossed(values: Floats, ratio: float, wanted: Mask) -> None:
    for a in range(wanted.shape[0]):
        for b in range(wanted.shape[1]):
            for c in range(wanted.shape[2]):
                inside, outside = False, False
                for i in range(_below(a, ratio), _above(a, ratio, values.shape[0])):
                    for j in range(_below(b, ratio), _above(b, ratio, values.shape[1])):
                        for k in range(_below(c, ratio), _above(c, ratio, values.shape[2])):
                            inside |= values[i, j, k] < 0.0
                            outside |= values[i, j, k] >= 0.0
                wanted[a, b, c] = inside and outside


@compiled
def _below(brick: int, ratio: float) -> int:
    """The coarse node at or before the cell that precedes a brick."""
    return max(int((SIDE * brick - 2) * ratio), 0)


@compiled
def _above(brick: int, ratio: float, size: int) -> int:
    """One past the coarse node at or behind the cell that follows a brick."""
    return min(int((SIDE * brick + SIDE + 1) * ratio) + 2, size)


@compiled
def _interpolate(values: Floats, ratio: float, places: NDArray[np.int32], found: Floats) -> None:
    """Trilinear; beyond the grid as at its rim."""
    last = np.array(values.shape) - 1.0
    for brick in range(len(places)):
        for i in range(SIDE):
            x = min((SIDE * places[brick, 0] + i) * ratio, last[0] - 1e-6)
            for j in range(SIDE):
                y = min((SIDE * places[brick, 1] + j) * ratio, last[1] - 1e-6)
                for k in range(SIDE):
                    z = min((SIDE * places[brick, 2] + k) * ratio, last[2] - 1e-6)
                    found[brick, i, j, k] = _trilinear(values, x, y, z)


@compiled
def _trilinear(values: Floats, x: float, y: float, z: float) -> float:
    a, b, c = int(x), int(y), int(z)
    p, q, r = x - a, y - b, z - c
    total = 0.0
    for corner in range(8):
        i, j, k = corner & 1, corner >> 1 & 1, corner >> 2
        share = (p if i else 1.0 - p) * (q if j else 1.0 - q) * (r if k else 1.0 - r)
        total += share * values[a + i, b + j, c + k]
    return total
