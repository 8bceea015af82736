"""A camera as a 3 x 4 matrix without a lens, from points of known position (Bolles et al. 1981)."""

from __future__ import annotations

import numpy as np
from scipy.linalg import rq

from bodyscan.arrays import Array
from bodyscan.calibration.zhang import homogeneous
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses.radial import Radial
from bodyscan.geometry.transforms import RigidTransform


def projection_matrix(points: Array, pixels: Array) -> Array:
    """Matrix (3, 4) with pixels ~ P X, from points (N, 3) mm not all in one plane and pixels (N,
    2).

    Direct linear transformation (Abdel-Aziz and Karara 1971) with Hartley's scaling.
    """
    space, image = _scaling(points), _scaling(pixels)
    x = homogeneous(points) @ space.T
    u, v = (homogeneous(pixels) @ image.T)[:, :2].T
    zero = np.zeros_like(x)
    rows = np.concatenate(
        [
            np.concatenate([x, zero, -u[:, None] * x], axis=1),
            np.concatenate([zero, x, -v[:, None] * x], axis=1),
        ]
    )
    _, vectors = np.linalg.eigh(rows.T @ rows)
    matrix = np.linalg.inv(image) @ vectors[:, 0].reshape(3, 4) @ space
    matrix /= np.linalg.norm(matrix[2, :3])
    return matrix * np.sign(matrix[2] @ np.append(points.mean(axis=0), 1.0))


def split_projection_matrix(
    matrix: Array, width: int, height: int
) -> tuple[Camera, RigidTransform]:
    """The matrix as a camera without a lens, and its pose: camera, camera_from_points."""
    inner, rotation = rq(matrix[:, :3])
    sign = np.diag(np.sign(np.diag(inner)))
    inner, rotation = inner @ sign, sign @ rotation
    translation = np.linalg.solve(inner, matrix[:, 3])
    if np.linalg.det(rotation) < 0.0:
        rotation, translation = -rotation, -translation
    inner = inner / inner[2, 2]
    camera = Camera(
        alpha=float(inner[0, 0]),
        beta=float(inner[1, 1]),
        gamma=float(inner[0, 1]),
        u0=float(inner[0, 2]),
        v0=float(inner[1, 2]),
        lens=Radial(),
        width=width,
        height=height,
    )
    return camera, RigidTransform(
        np.asarray(rotation, np.float64), np.asarray(translation, np.float64)
    )


def _scaling(places: Array) -> Array:
    """Matrix (D + 1, D + 1) that scales places to mean 0 and a mean distance of sqrt(D)."""
    size = places.shape[1]
    mean = places.mean(axis=0)
    scale = np.sqrt(size) / float(np.mean(np.linalg.norm(places - mean, axis=1)))
    matrix = np.eye(size + 1)
    matrix[:size] *= scale
    matrix[:size, size] = -scale * mean
    return matrix
