"""How far points lie from a known surface."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import open3d as o3d
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from bodyscan.arrays import Array, Indices, Mask
from bodyscan.geometry.robust import rms
from bodyscan.mesh.nearest_surface import build_centred_scene
from bodyscan.mesh.topology import directed_edges

ON_EDGE = 1e-5  # of a barycentric coordinate, in float32


@dataclass(frozen=True)
class Deviation:
    """Statistics of signed distances (outside is positive), mm."""

    count: int
    bias_mm: float
    median_mm: float  # of the absolute distances
    rms_mm: float
    p95_mm: float  # of the absolute distances
    worst_mm: float


def signed_distances(points: Array, vertices: Array, faces: Indices) -> Array:
    """Distances (N,) mm of points (N, 3) from a closed triangle mesh, positive outside it.

    The sign is that of the angle-weighted pseudo-normal at the nearest spot (Baerentzen and Aanaes
    2005).
    """
    scene, centre = build_centred_scene(vertices, faces)
    centred = (points - centre).astype(np.float32)
    nearest = scene.compute_closest_points(o3d.core.Tensor(centred))
    offset = centred.astype(np.float64) - nearest["points"].numpy()
    distance = np.linalg.norm(offset, axis=-1)
    face = nearest["primitive_ids"].numpy().astype(np.int64)
    u, v = nearest["primitive_uvs"].numpy().astype(np.float64).T
    normals = _pseudo_normals(vertices, faces, face, np.stack([1.0 - u - v, u, v], axis=-1))
    return np.where(np.einsum("nc,nc->n", offset, normals) >= 0, distance, -distance)


def _pseudo_normals(vertices: Array, faces: Indices, face: Indices, barycentric: Array) -> Array:
    """(N, 3): normals, of any length, at spots on faces: the face's, or its edge's or corner's."""
    corners = vertices[faces]
    sides = np.roll(corners, -1, axis=1) - corners  # side k runs from corner k to the next
    cross = np.cross(sides[:, 0], sides[:, 1])
    unit = cross / np.maximum(np.linalg.norm(cross, axis=-1, keepdims=True), 1e-300)
    normals = unit[face]
    low = barycentric < ON_EDGE
    on_side = low[:, [2, 0, 1]]  # side k lies opposite corner k + 2
    spot, side = np.nonzero(on_side & (low.sum(axis=1, keepdims=True) == 1))
    normals[spot] += unit[_neighbours(faces)[face[spot], side]]
    spot = np.flatnonzero(low.sum(axis=1) >= 2)
    corner = faces[face[spot], np.argmax(barycentric[spot], axis=1)]
    normals[spot] = _corner_normals(len(vertices), faces, sides, unit)[corner]
    return normals


def _neighbours(faces: Indices) -> Indices:
    """(F, 3): the face across each side, or the face itself if there is none."""
    edges, count = directed_edges(faces), int(faces.max()) + 1
    keys, opposite = edges[:, 0] * count + edges[:, 1], edges[:, 1] * count + edges[:, 0]
    order = np.argsort(keys)
    place = order[np.minimum(np.searchsorted(keys[order], opposite), len(keys) - 1)]
    own = np.tile(np.arange(len(faces)), 3)
    return np.where(keys[place] == opposite, place % len(faces), own).reshape(3, -1).T


def _corner_normals(count: int, faces: Indices, sides: Array, unit: Array) -> Array:
    """(V, 3): sums of the normals around each vertex, weighted by the faces' angles there."""
    along = sides / np.maximum(np.linalg.norm(sides, axis=-1, keepdims=True), 1e-300)
    cosine = -np.einsum("fkc,fkc->fk", along, np.roll(along, 1, axis=1))
    weighted = np.arccos(cosine.clip(-1.0, 1.0))[..., None] * unit[:, None]
    return np.stack(
        [np.bincount(faces.ravel(), weighted[..., k].ravel(), count) for k in range(3)], axis=-1
    )


def deviation(signed_mm: Array) -> Deviation:
    """Bias, median, RMS, 95th percentile and worst of signed distances (N,)."""
    size = np.abs(signed_mm)
    return Deviation(
        len(signed_mm),
        float(np.mean(signed_mm)),
        float(np.median(size)),
        rms(signed_mm),
        float(np.percentile(size, 95)),
        float(size.max()),
    )


def normalized_errors(signed_mm: Array, sigma_mm: NDArray[np.floating[Any]]) -> tuple[float, float]:
    """Robust sigma of errors over their sigmas (1 if honest), and the share beyond three sigmas
    (0.003 if Gaussian)."""
    over = np.abs(signed_mm / sigma_mm)
    return float(np.median(over) / 0.6745), float(np.mean(over > 3.0))


def covered_spots(
    points: Array, spots: Array, normals: Array, within_mm: float = 1.0, spacing_mm: float = 2.0
) -> Mask:
    """Which spots (N, 3) of a surface with normals (N, 3) are covered by points (M, 3), (N,).

    A spot is covered if a point lies within `within_mm` along the surface's normal and, sideways,
    within `spacing_mm`, since even a perfect cloud has gaps between its points.
    """
    distance, index = cKDTree(points).query(spots, k=4, distance_upper_bound=spacing_mm + within_mm)
    found = np.isfinite(distance)
    offset = points[np.where(found, index, 0)] - spots[:, None]
    along = np.einsum("nkc,nc->nk", offset, normals)
    sideways = np.sqrt(np.maximum(np.sum(offset**2, axis=-1) - along**2, 0.0))
    close = found & (np.abs(along) < within_mm) & (sideways < spacing_mm)
    return np.asarray(close.any(axis=1))


def sample_surface(
    vertices: Array, faces: Indices, count: int, seed: int = 0
) -> tuple[Array, Array]:
    """Random points (N, 3) on a mesh, uniform in area, and the normals (N, 3) of their faces."""
    rng = np.random.default_rng(seed)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    area = np.linalg.norm(cross, axis=-1)
    chosen = rng.choice(len(faces), count, p=area / area.sum())
    root, t = np.sqrt(rng.random((count, 1))), rng.random((count, 1))
    points = (1 - root) * a[chosen] + root * (1 - t) * b[chosen] + root * t * c[chosen]
    return points, cross[chosen] / area[chosen, None]
