"""Hints for the surface where nobody measured it: not where cameras saw through, not in the floor.

A rough Poisson surface closes gaps with webs. It is filled with voxels; those that were seen
through, or lie below the floor, are taken away; what is left is smoothed, and points of its
surface, away from the measured ones, tell the final Poisson surface where to go.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import open3d as o3d
from scipy import ndimage
from scipy.spatial import cKDTree

from bodyscan.arrays import Array, Floats, Indices, Mask
from bodyscan.fusion.free_space import Guess, sees_through
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.progress import THREADS
from bodyscan.reconstruction.range_image import RangeImage

VOXEL_MM = 5.0
SMOOTHING_VOXELS = 1.0
REACH_VOXELS = 3
CLEARANCE_MM = 8.0  # no hint closer to a measured point


@dataclass(frozen=True, eq=False)
class Voxels:
    """What is inside a surface: (nx, ny, nz) booleans, and the first voxel's centre, mm."""

    inside: Mask
    origin: Array

    def centres(self, index: Indices) -> Floats:
        """(N, 3) mm of voxels (N, 3)."""
        return (self.origin + VOXEL_MM * index).astype(np.float32)


def poisson_hints(
    vertices: Array,
    faces: Indices,
    filled: Mask,
    measured: cKDTree,
    range_images: Sequence[RangeImage],
    rig_from_camera: dict[str, RigidTransform],
    *,
    margin_mm: float = 10.0,
    workers: int = THREADS,
) -> tuple[Array, Array]:
    """Points (N, 3) and outward normals (N, 3) of a likely surface where nothing was measured.

    vertices, faces, filled: a rough closed surface, and which of its faces are filled.
    measured: the tree of the cloud's points.
    """
    guess = Guess.of(vertices, faces, filled)
    voxels = voxels_inside(guess, vertices)
    index = np.argwhere(voxels.inside)
    centres = voxels.centres(index)
    with ThreadPoolExecutor(workers) as pool:
        votes = pool.map(
            lambda image: sees_through(
                centres, guess, image, rig_from_camera[image.pair], margin_mm
            ),
            range_images,
        )
        free = np.logical_or.reduce(list(votes))
    free |= centres[:, 2] < 0.0
    removed = np.zeros_like(voxels.inside)
    removed[tuple(index[free].T)] = True
    return _skin(voxels, removed, measured)


def voxels_inside(guess: Guess, vertices: Array) -> Voxels:
    """The voxels inside a closed surface, by one vertical ray for each column of them."""
    # The floor, z = 0, lies between two layers.
    origin = (np.floor(vertices.min(axis=0) / VOXEL_MM) - 3.5) * VOXEL_MM
    shape = tuple(np.ceil((vertices.max(axis=0) - origin) / VOXEL_MM).astype(int) + 4)
    x, y = np.meshgrid(np.arange(shape[0]), np.arange(shape[1]), indexing="ij")
    rays = np.zeros((x.size, 6), np.float32)
    rays[:, 0], rays[:, 1] = origin[0] + VOXEL_MM * x.ravel(), origin[1] + VOXEL_MM * y.ravel()
    rays[:, 2], rays[:, 5] = origin[2], 1.0
    crossings = guess.scene.list_intersections(o3d.core.Tensor(rays))
    ray = crossings["ray_ids"].numpy()
    layer = np.ceil(crossings["t_hit"].numpy() / VOXEL_MM).astype(int)
    toggles = np.zeros((x.size, shape[2]), np.int8)
    np.add.at(toggles, (ray, np.minimum(layer, shape[2] - 1)), 1)
    inside = np.cumsum(toggles, axis=1, dtype=np.int8) % 2 == 1
    # A ray through an edge may count it twice or not at all: such a column shows no way out.
    inside[inside[:, -1]] = False
    return Voxels(inside.reshape(shape), origin)


def _skin(voxels: Voxels, removed: Mask, measured: cKDTree) -> tuple[Array, Array]:
    """Points and outward normals where what is left of the voxels, smoothed, ends.

    Only near removed voxels, where the rough surface was wrong, and away from measured points.
    """
    left = voxels.inside & ~removed
    soft = ndimage.gaussian_filter(left.astype(np.float32), SMOOTHING_VOXELS)
    index = np.concatenate([_crossings(soft, axis) for axis in range(3)])
    concerned = ndimage.maximum_filter(removed.view(np.uint8), 2 * REACH_VOXELS + 1) > 0
    index = index[concerned[tuple(np.rint(index).astype(int).T)]]
    places = voxels.origin + VOXEL_MM * index
    nearby = measured.query(places, distance_upper_bound=CLEARANCE_MM, workers=THREADS)[0] < np.inf
    index, places = index[~nearby], places[~nearby]
    normals = -_slopes(soft, index)
    return places, normals / np.linalg.norm(normals, axis=-1, keepdims=True)


def _slopes(values: Floats, index: Array) -> Array:
    """(N, 3) central differences at places (N, 3) between voxels, interpolated linearly."""
    around = index + np.concatenate([np.eye(3), -np.eye(3)])[:, None]
    found = ndimage.map_coordinates(values, around.reshape(-1, 3).T, order=1, output=np.float64)
    ahead, behind = found.reshape(2, 3, -1)
    return np.asarray(0.5 * (ahead - behind).T)


def _crossings(soft: Floats, axis: int) -> Array:
    """(N, 3) places, in voxels, where the value passes 0.5 between neighbours along an axis."""
    turned = np.moveaxis(soft, axis, 0)
    low, high = turned[:-1], turned[1:]
    at = np.nonzero((low > 0.5) != (high > 0.5))
    share = (0.5 - low[at]) / (high[at] - low[at])
    return np.insert(np.stack(at[1:], axis=-1).astype(np.float64), axis, at[0] + share, axis=1)
