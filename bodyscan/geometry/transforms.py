"""Rigid transforms whose names chain: `rig_from_camera @ camera_from_board`."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from bodyscan.arrays import Array


@dataclass(frozen=True, eq=False)
class RigidTransform:
    """`a_from_b`: takes coordinates in frame b to coordinates in frame a.

    rotation: (3, 3) orthonormal, determinant +1.
    translation: (3,) mm, b's origin in a.
    """

    rotation: Array
    translation: Array

    @staticmethod
    def identity() -> RigidTransform:
        return RigidTransform(np.eye(3), np.zeros(3))

    @staticmethod
    def from_translation(translation: ArrayLike) -> RigidTransform:
        """By (3,) mm, without a turn."""
        return RigidTransform(np.eye(3), np.asarray(translation, float))

    @staticmethod
    def from_rotation_vector(rotation_vector: ArrayLike, translation: ArrayLike) -> RigidTransform:
        """From axis times angle (3,), radians, and a translation (3,), mm."""
        rotation = cv2.Rodrigues(np.asarray(rotation_vector, float))[0]  # a tenth of scipy's time
        return RigidTransform(rotation, np.asarray(translation, float))

    @staticmethod
    def from_matrix(matrix: ArrayLike) -> RigidTransform:
        """From a (4, 4) or (3, 4) matrix, its rotation part replaced by the nearest rotation."""
        matrix = np.asarray(matrix, float)
        u, _, vt = np.linalg.svd(matrix[:3, :3])
        rotation = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
        return RigidTransform(rotation, matrix[:3, 3].copy())

    @property
    def matrix(self) -> Array:
        """Homogeneous matrix (4, 4)."""
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = self.rotation, self.translation
        return matrix

    @property
    def rotation_vector(self) -> Array:
        """Axis times angle (3,), radians."""
        return Rotation.from_matrix(self.rotation).as_rotvec()

    @property
    def twist(self) -> Array:
        """Rotation vector (radians), then translation (mm), (6,): what `retract` takes."""
        return np.concatenate([self.rotation_vector, self.translation])

    @property
    def angle(self) -> float:
        """Angle of the rotation, radians."""
        # |R - 1| = 2 sqrt(2) sin(angle / 2): accurate for small angles too.
        half = np.linalg.norm(self.rotation - np.eye(3)) / np.sqrt(8.0)
        return float(2.0 * np.arcsin(min(half, 1.0)))

    def __matmul__(self, other: RigidTransform) -> RigidTransform:
        translation = self.rotation @ other.translation + self.translation
        return RigidTransform(self.rotation @ other.rotation, translation)

    def inverse(self) -> RigidTransform:
        return RigidTransform(self.rotation.T, -self.rotation.T @ self.translation)

    def apply(self, points: Array) -> Array:
        """Points (..., 3) in b to points (..., 3) in a."""
        return points @ self.rotation.T + self.translation

    def rotate(self, directions: Array) -> Array:
        """Directions (..., 3) in b to directions (..., 3) in a."""
        return directions @ self.rotation.T

    def retract(self, twist: ArrayLike) -> RigidTransform:
        """Apply a small motion in frame a on the left: exp(twist) @ self, to first order.

        twist: (6,) rotation vector (radians), then translation (mm).
        """
        twist = np.asarray(twist, float)
        return RigidTransform.from_rotation_vector(twist[:3], twist[3:]) @ self


def make_cross_matrix(vectors: Array) -> Array:
    """Cross-product matrices (..., 3, 3) of vectors (..., 3): cross_matrix(a) @ b = a x b."""
    zero = np.zeros(vectors.shape[:-1])
    x, y, z = vectors[..., 0], vectors[..., 1], vectors[..., 2]
    rows = [zero, -z, y, z, zero, -x, -y, x, zero]
    return np.stack(rows, axis=-1).reshape(*vectors.shape[:-1], 3, 3)


def adjoint(a_from_b: RigidTransform) -> Array:
    """Matrix (6, 6) that carries a twist (rotation, translation) in b to the same motion in a."""
    rotation = a_from_b.rotation
    matrix = np.zeros((6, 6))
    matrix[:3, :3] = matrix[3:, 3:] = rotation
    matrix[3:, :3] = make_cross_matrix(a_from_b.translation) @ rotation
    return matrix


def twist_jacobian(points: Array) -> Array:
    """d(point)/d(twist) (..., 3, 6) when a small motion acts on points (..., 3) in their own frame."""
    unit = np.broadcast_to(np.eye(3), (*points.shape, 3))
    return np.concatenate([-make_cross_matrix(points), unit], axis=-1)


def fit_rigid_transform(source: Array, target: Array) -> RigidTransform:
    """`target_from_source` that carries points (N, 3) onto (N, 3) best in least squares.

    Source: Arun, Huang, Blostein 1987, with Umeyama's correction against reflections.
    """
    source_mean, target_mean = source.mean(axis=0), target.mean(axis=0)
    products = (target - target_mean).T @ (source - source_mean)
    rotation = RigidTransform.from_matrix(np.pad(products, ((0, 0), (0, 1)))).rotation
    return RigidTransform(rotation, target_mean - rotation @ source_mean)
