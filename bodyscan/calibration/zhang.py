"""Zhang's closed form: homographies of a plane, the camera matrix with skew, poses of the plane.

Source: Z. Zhang, A Flexible New Technique for Camera Calibration, PAMI 22(11), 2000.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bodyscan.arrays import Array
from bodyscan.errors import DegeneratePoses
from bodyscan.geometry.transforms import RigidTransform


def homography(plane: Array, pixels: Array) -> Array:
    """Estimate H (3, 3), pixels ~ H (x, y, 1), from plane points and pixels (N, 2) each, N > 4.

    Normalised direct linear transformation (Hartley 1997).
    """
    plane_norm, pixel_norm = _normalization(plane), _normalization(pixels)
    x, y = (homogeneous(plane) @ plane_norm.T)[:, :2].T
    u, v = (homogeneous(pixels) @ pixel_norm.T)[:, :2].T
    zero, one = np.zeros_like(x), np.ones_like(x)
    rows_u = np.stack([x, y, one, zero, zero, zero, -u * x, -u * y, -u], axis=1)
    rows_v = np.stack([zero, zero, zero, x, y, one, -v * x, -v * y, -v], axis=1)
    _, _, vt = np.linalg.svd(np.concatenate([rows_u, rows_v]), full_matrices=False)
    h = np.linalg.inv(pixel_norm) @ vt[-1].reshape(3, 3) @ plane_norm
    return h / h[2, 2]


def matrix_from_homographies(homographies: Sequence[Array], width: int, height: int) -> Array:
    """Estimate A of Eq. 1 with skew, (3, 3), from at least three homographies.

    Falls back to a camera without skew and with a central principal point if noise leaves the full
    form without a real solution. Raises DegeneratePoses if the planes are (nearly) parallel.
    """
    refuse_parallel(homographies, width, height)
    size = np.diag([2.0 / width, 2.0 / width, 1.0]) @ np.array(
        [[1, 0, -width / 2], [0, 1, -height / 2], [0, 0, 1.0]]
    )
    scaled = [size @ h for h in homographies]
    scaled = [h / np.linalg.norm(h[:, :2]) * np.sqrt(2) for h in scaled]
    matrix = _full_matrix(scaled)
    if matrix is None:
        matrix = _central_matrix(scaled)
    return np.linalg.inv(size) @ matrix


def refuse_parallel(homographies: Sequence[Array], width: int, height: int) -> None:
    """Raise DegeneratePoses if all planes have one orientation (pure translation, Zhang 1998).

    Parallel planes share their vanishing line, which a rough camera turns into a plane normal.
    """
    rough = np.array([[1.2 * width, 0, width / 2], [0, 1.2 * width, height / 2], [0, 0, 1.0]])
    lines = np.stack([np.linalg.inv(h).T[:, 2] for h in homographies])
    normals = lines @ rough
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    angles = np.degrees(np.arccos(np.clip(np.abs(normals @ normals.T), 0.0, 1.0)))
    if np.max(angles) < 3.0:
        raise DegeneratePoses(
            f"the {len(homographies)} board poses differ by a translation only "
            f"(their orientations agree within {np.max(angles):.1f} degrees)",
            remedy="tilt the board by 15 to 35 degrees about different axes between the shots",
        )


def camera_from_plane(normalized_homography: Array, plane_z: float = 0.0) -> RigidTransform:
    """Compute the pose of a plane from its homography to normalised image coordinates.

    Points (x, y, plane_z) of the plane's frame; the side with positive depth is taken.
    """
    h = normalized_homography / np.sqrt(
        np.linalg.norm(normalized_homography[:, 0]) * np.linalg.norm(normalized_homography[:, 1])
    )
    h = h * np.sign(h[2, 2])
    r3 = np.cross(h[:, 0], h[:, 1])
    pose = RigidTransform.from_matrix(np.column_stack([h[:, 0], h[:, 1], r3, h[:, 2]]))
    return RigidTransform(pose.rotation, pose.translation - plane_z * pose.rotation[:, 2])


def _full_matrix(homographies: Sequence[Array]) -> Array | None:
    """Solve for A with skew and principal point; None if the solution is no camera."""
    rows = [_constraint(h, 0, 1) for h in homographies]
    rows += [_constraint(h, 0, 0) - _constraint(h, 1, 1) for h in homographies]
    _, _, vt = np.linalg.svd(np.stack(rows))
    b11, b12, b22, b13, b23, b33 = vt[-1] * np.sign(vt[-1][0])
    conic = np.array([[b11, b12, b13], [b12, b22, b23], [b13, b23, b33]])
    if np.any(np.linalg.eigvalsh(conic) <= 0):
        return None
    # B ~ A^-T A^-1, so its Cholesky factor L has L^T ~ A^-1.
    matrix = np.linalg.inv(np.linalg.cholesky(conic).T)
    matrix = matrix / matrix[2, 2]
    plausible = abs(matrix[0, 1]) < 0.1 * matrix[0, 0] and np.all(np.abs(matrix[:2, 2]) < 0.5)
    return matrix if plausible and 0.7 < matrix[0, 0] / matrix[1, 1] < 1.4 else None


def _central_matrix(homographies: Sequence[Array]) -> Array:
    """Solve for A with a focal length only."""
    rows, right = [], []
    for h in homographies:
        for row in (_constraint(h, 0, 1), _constraint(h, 0, 0) - _constraint(h, 1, 1)):
            rows.append([row[0] + row[2]])
            right.append(-row[5])
    inverse_square = np.linalg.lstsq(np.array(rows), np.array(right), rcond=None)[0][0]
    focal = 1.0 / np.sqrt(inverse_square) if inverse_square > 0 else 2.4
    return np.diag([focal, focal, 1.0])


def _constraint(h: Array, i: int, j: int) -> Array:
    """Coefficients v_ij of h_i^T B h_j in (B11, B12, B22, B13, B23, B33) (Zhang 2000, Eq. 7)."""
    a, b = h[:, i], h[:, j]
    twice = np.outer(a, b) + np.outer(b, a)
    return np.array([a[0] * b[0], twice[0, 1], a[1] * b[1], twice[0, 2], twice[1, 2], a[2] * b[2]])


def _normalization(points: Array) -> Array:
    """Similarity (3, 3) that centres points (N, 2) and scales their mean distance to sqrt(2)."""
    mean = points.mean(axis=0)
    scale = np.sqrt(2.0) / max(float(np.mean(np.linalg.norm(points - mean, axis=1))), 1e-12)
    return np.array([[scale, 0, -scale * mean[0]], [0, scale, -scale * mean[1]], [0, 0, 1.0]])


def homogeneous(points: Array) -> Array:
    """Append ones to points (N, D)."""
    return np.column_stack([points, np.ones(len(points))])
