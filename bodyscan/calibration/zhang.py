"""Zhang's closed form: the camera matrix with skew from homographies of a plane.

Source: Z. Zhang, A Flexible New Technique for Camera Calibration, PAMI 22(11), 2000.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bodyscan.arrays import Array


def matrix_from_homographies(homographies: Sequence[Array], width: int, height: int) -> Array:
    """Estimate A of Eq. 1 with skew, (3, 3), from at least three homographies.

    Falls back to a camera without skew and with a central principal point if noise leaves the full
    form without a real solution.
    """
    size = np.diag([2.0 / width, 2.0 / width, 1.0]) @ np.array(
        [[1, 0, -width / 2], [0, 1, -height / 2], [0, 0, 1.0]]
    )
    scaled = [size @ h for h in homographies]
    scaled = [h / np.linalg.norm(h[:, :2]) * np.sqrt(2) for h in scaled]
    rows = np.stack(
        [_form_constraint(h, 0, 1) for h in scaled]
        + [_form_constraint(h, 0, 0) - _form_constraint(h, 1, 1) for h in scaled]
    )
    matrix = _solve_full_matrix(rows)
    if matrix is None:
        square = rows[:, 0] + rows[:, 2]
        inverse_square = -(square @ rows[:, 5]) / (square @ square)
        # Focal lengths are in halves of the image's width: 50 is a field of view of 2 degrees.
        focal = inverse_square**-0.5 if inverse_square > 50.0**-2 else 2.4
        matrix = np.diag([focal, focal, 1.0])
    return np.linalg.inv(size) @ matrix


def _solve_full_matrix(rows: Array) -> Array | None:
    """Solve for A with skew and principal point; None if the solution is no camera."""
    _, _, vt = np.linalg.svd(rows)
    b11, b12, b22, b13, b23, b33 = vt[-1] * np.sign(vt[-1][0])
    conic = np.array([[b11, b12, b13], [b12, b22, b23], [b13, b23, b33]])
    if np.any(np.linalg.eigvalsh(conic) <= 0):
        return None
    # B ~ A^-T A^-1, so its Cholesky factor L has L^T ~ A^-1.
    matrix = np.linalg.inv(np.linalg.cholesky(conic).T)
    matrix = matrix / matrix[2, 2]
    plausible = abs(matrix[0, 1]) < 0.1 * matrix[0, 0] and np.all(np.abs(matrix[:2, 2]) < 0.5)
    # Fields of interlaced video and anamorphic lenses have pixels twice as high as wide, or half.
    plausible = plausible and matrix[0, 0] < 50.0 and 0.4 < matrix[0, 0] / matrix[1, 1] < 2.5
    return matrix if plausible else None


def _form_constraint(h: Array, i: int, j: int) -> Array:
    """Coefficients v_ij of h_i^T B h_j in (B11, B12, B22, B13, B23, B33) (Zhang 2000, Eq. 7)."""
    a, b = h[:, i], h[:, j]
    twice = np.outer(a, b) + np.outer(b, a)
    return np.array([a[0] * b[0], twice[0, 1], a[1] * b[1], twice[0, 2], twice[1, 2], a[2] * b[2]])
