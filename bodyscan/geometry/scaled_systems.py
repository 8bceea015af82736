"""Normal equations whose unknowns differ in unit (px, radians, mm, stripes), solved and inverted.

Rows and columns are scaled to a unit diagonal first. Otherwise a covariance in mm and one in
radians differ by so many powers of ten that the smaller is lost.
"""

from __future__ import annotations

import numpy as np

from bodyscan.arrays import Array

RANK = 1e-14
"""Directions of a scaled matrix with less than this share of the largest are left open."""
BLOCK = 128


def solve_scaled(matrix: Array, right: Array, damping: Array | float = 0.0) -> Array:
    """Solve matrix x = right for one symmetric system or many.

    matrix: (..., P, P).
    right: (..., P).
    damping: (...), added to the scaled diagonal (Marquardt).

    A singular system gives the shortest scaled solution.
    """
    size = _size(matrix)
    scaled = matrix / (size[..., :, None] * size[..., None, :])
    diagonal = np.einsum("...ii->...i", scaled)
    diagonal += np.asarray(damping)[..., None]
    columns = (right / size)[..., None]
    try:
        solved = np.linalg.solve(scaled, columns)
    except np.linalg.LinAlgError:
        solved = _pseudo_inverse(scaled) @ columns
    return np.asarray(solved[..., 0] / size, np.float64)


def invert_scaled(matrix: Array) -> Array:
    """Pseudo-inverse (..., P, P) of symmetric matrices (..., P, P); NaN for those not finite."""
    size = _size(matrix)
    outer = size[..., :, None] * size[..., None, :]
    scaled = matrix / outer
    try:
        factor = np.linalg.cholesky(scaled)
        regular = bool(np.einsum("...ii->...i", factor).min(initial=1.0) ** 2 > RANK)
    except np.linalg.LinAlgError:
        regular = False
    # Eigenvalues take ten times as long and are needed only where the rank is in doubt.
    inverse = np.linalg.inv(scaled) if regular else _pseudo_inverse(scaled)
    return np.asarray(0.5 * (inverse + np.swapaxes(inverse, -1, -2)) / outer, np.float64)


def _pseudo_inverse(scaled: Array) -> Array:
    finite = np.isfinite(scaled).all(axis=(-2, -1))
    inverse = np.full(scaled.shape, np.nan)
    inverse[finite] = np.linalg.pinv(scaled[finite], RANK, hermitian=True)
    return inverse


def gram(left: Array, right: Array) -> Array:
    """left.T @ right for tall matrices, in blocks too small for BLAS to start threads: pairs are
    fitted side by side, and threads waiting for a core cost several times what they save."""
    blocks = len(left) // BLOCK
    if not blocks:
        return np.asarray(left.T @ right, np.float64)
    cut = blocks * BLOCK
    head, tail = (matrix[:cut].reshape(blocks, BLOCK, -1) for matrix in (left, right))
    return np.sum(head.transpose(0, 2, 1) @ tail, axis=0) + left[cut:].T @ right[cut:]


def _size(matrix: Array) -> Array:
    """Square roots (..., P) of the diagonal; tiny but positive for an unknown without influence."""
    return np.sqrt(np.maximum(np.einsum("...ii->...i", matrix), 1e-300))
