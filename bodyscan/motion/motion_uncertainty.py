"""Uncertainty of a body's shape that remains after its motion was estimated."""

from __future__ import annotations

import numpy as np
from scipy import sparse

from bodyscan.alignment.sway_prior import BODY_CENTRE
from bodyscan.arrays import Array, Mask
from bodyscan.motion.body_cells import BodyCells
from bodyscan.motion.body_motion import BodyMotion


def shape_sigmas(motion: BodyMotion, cells: BodyCells, observed: Mask) -> tuple[Array, Array]:
    """Standard deviations (C,) mm of the shape along the normals, without motions of the whole; and
    those of `girth_sigmas`.

    observed: which pairs measured which cells, (P, C).

    Computed at the landmarks and interpolated with a Gaussian kernel of 60 mm.
    """
    pair, mark = np.nonzero(observed[:, cells.landmarks])
    cell = cells.landmarks[mark]
    rows = np.concatenate(
        [
            motion.observation_matrix(k, cell[pair == k], cells.normals[cell[pair == k]])
            for k in np.unique(pair)
        ]
    )
    offsets, normals = cells.centres[cell] - BODY_CENTRE, cells.normals[cell]
    rigid = np.linalg.qr(np.hstack([np.cross(offsets, normals), normals]))[0]
    rows -= rigid @ (rigid.T @ rows)
    # A point is the mean of what all pairs measured of it.
    views = np.bincount(mark, minlength=len(cells.landmarks))
    shape = len(views), len(mark)
    means = sparse.csr_array((1.0 / views[mark], (mark, np.arange(len(mark)))), shape=shape) @ rows
    errors = means @ np.linalg.cholesky(motion.covariance)
    girth = girth_sigmas(errors, cells.centres[cells.landmarks, 2], 60.0)
    variances = np.stack([np.sum(errors**2, axis=1), girth**2])
    kernel = np.exp(-0.5 * (cells.landmark_distances / 60.0) ** 2) * (views > 0)[:, None]
    sigma, girth = np.sqrt(variances @ kernel / np.maximum(kernel.sum(axis=0), 1e-12))
    return sigma, girth


def girth_sigmas(errors: Array, height: Array, near_mm: float = 20.0) -> Array:
    """Standard deviations (C,) mm of displacements with factor errors (C, n), as they affect a girth.

    Only what cells within `near_mm` of height (C,) mm share changes a girth.
    """
    kernel = np.exp(-0.5 * ((height[:, None] - height) / near_mm) ** 2)
    sigma = np.linalg.norm(errors, axis=1)
    return sigma * np.linalg.norm(kernel @ errors, axis=1) / np.maximum(kernel @ sigma, 1e-12)
