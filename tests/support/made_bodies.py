"""Meshes whose girths, volumes and areas are known from formulas."""

from __future__ import annotations

import numpy as np
import open3d as o3d
from numpy.typing import ArrayLike

from bodyscan.arrays import Array, Indices
from bodyscan.mesh.body import BodyCloud, BodyMesh
from bodyscan.mesh.topology import compute_vertex_normals


def cloud_of(points: np.ndarray, normals: np.ndarray, sigma_mm: float = 0.1) -> BodyCloud:
    """Grey points (N, 3) with normals (N, 3) or (3,), each seen by one pair."""
    count = len(points)
    return BodyCloud(
        np.ascontiguousarray(points, np.float64),
        np.broadcast_to(normals, points.shape).astype(np.float32),
        np.full(count, sigma_mm, np.float32),
        np.full((count, 3), 128, np.uint8),
        np.ones(count, np.uint8),
    )


def mesh_of(
    vertices: np.ndarray,
    faces: np.ndarray,
    filled: np.ndarray | None = None,
    *,
    colours: ArrayLike = 128,
    sigma_mm: ArrayLike = 0.1,
) -> BodyMesh:
    """Grey, of one sigma and measured everywhere unless said otherwise; faces are filled that have a
    vertex without a sigma."""
    sigma = np.broadcast_to(np.asarray(sigma_mm, np.float32), len(vertices)).copy()
    return BodyMesh(
        np.asarray(vertices, float),
        np.asarray(faces, np.int64),
        compute_vertex_normals(vertices, faces),
        np.broadcast_to(np.asarray(colours), (len(vertices), 3)).astype(np.uint8),
        sigma,
        np.isnan(sigma)[faces].any(axis=1) if filled is None else filled,
    )


def arrays(made: o3d.geometry.TriangleMesh) -> tuple[np.ndarray, np.ndarray]:
    return np.asarray(made.vertices), np.asarray(made.triangles).astype(np.int64)


def ellipsoid(
    axes: ArrayLike, centre: ArrayLike = (0.0, 0.0, 0.0), resolution: int = 200
) -> tuple[np.ndarray, np.ndarray]:
    vertices, faces = arrays(o3d.geometry.TriangleMesh.create_sphere(1.0, resolution=resolution))
    return vertices * np.asarray(axes) + np.asarray(centre), faces


def cylinder(
    radius: float, low: float, high: float, x: float = 0.0, y: float = 0.0
) -> tuple[Array, Indices]:
    made = o3d.geometry.TriangleMesh.create_cylinder(radius, high - low, resolution=400, split=50)
    vertices, faces = arrays(made)
    return vertices + [x, y, 0.5 * (low + high)], faces


def together(*bodies: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Several closed surfaces in one mesh."""
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in bodies)])
    return (
        np.concatenate([vertices for vertices, _ in bodies]),
        np.concatenate([faces + start for (_, faces), start in zip(bodies, starts, strict=False)]),
    )


def boxes(*ends: tuple[tuple[int, int, int], tuple[int, int, int]]) -> tuple[Array, Indices]:
    """The closed surface of boxes made one; two corners of each in multiples of 10 mm."""
    corners = 10 * np.array(ends)
    low = corners.min(axis=(0, 1)) - 10
    full = np.zeros((corners.max(axis=(0, 1)) + 10 - low) // 10, bool)
    for first, last in (corners - low) // 10:
        full[first[0] : last[0], first[1] : last[1], first[2] : last[2]] = True
    quads = []
    for axis in range(3):
        one, other = np.eye(3, dtype=int)[(axis + 1) % 3], np.eye(3, dtype=int)[(axis + 2) % 3]
        for step in (-1, 1):
            open_ = full & ~np.roll(full, -step, axis)
            start = np.argwhere(open_) + (step > 0) * np.eye(3, dtype=int)[axis]
            ring = [start, start + one, start + one + other, start + other]
            quads.append(np.stack(ring[:: 1 if step > 0 else -1], axis=1))
    places, number = np.unique(np.concatenate(quads).reshape(-1, 3), axis=0, return_inverse=True)
    around = number.reshape(-1, 4)
    return 10.0 * places + low, np.concatenate([around[:, [0, 1, 2]], around[:, [0, 2, 3]]])
