"""Uncertainty of a body's shape that remains after its motion was estimated."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import sparse

from bodyscan.alignment.sway_prior import BODY_CENTRE
from bodyscan.arrays import Array, Mask
from bodyscan.motion.body_cells import BodyCells
from bodyscan.motion.body_motion import BodyMotion
from bodyscan.motion.body_parts import LEGS, PARTS, limb_weights, name_parts


def shape_sigmas(motion: BodyMotion, cells: BodyCells, observed: Mask) -> Array:
    """Standard deviations (C,) mm of the shape along the normals, without motions of the whole.

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
    # Legs stand on the floor: motion of theirs that the overlaps do not require did not happen.
    is_leg = np.isin(name_parts(cells)[cells.landmarks], [PARTS.index(leg) for leg in LEGS])
    variance = np.sum((means @ motion.covariance) * means, axis=1)
    others = means[~is_leg]
    variance[~is_leg] = np.sum((others @ motion.covariance_with_min_parts()) * others, axis=1)
    variance += _unobserved_breath(motion, cells, observed)[cells.landmarks] ** 2
    kernel = np.exp(-0.5 * (cells.landmark_distances / 60.0) ** 2) * (views > 0)[:, None]
    interpolated = variance @ kernel / np.maximum(kernel.sum(axis=0), 1e-12)
    return np.sqrt(interpolated + _border_variance(motion, cells, observed))


def girth_sigmas(errors: Array, height: Array) -> Array:
    """Standard deviations (C,) mm of displacements with factor errors (C, n), as they affect a girth.

    Only what cells within 20 mm of height (C,) mm share changes a girth.
    """
    kernel = np.exp(-0.5 * ((height[:, None] - height) / 20.0) ** 2)
    sigma = np.linalg.norm(errors, axis=1)
    return sigma * np.linalg.norm(kernel @ errors, axis=1) / np.maximum(kernel @ sigma, 1e-12)


def _border_variance(motion: BodyMotion, cells: BodyCells, observed: Mask) -> Array:
    """Variance (C,) mm^2 along the normals from the unknown share with which borders follow limbs.

    There skin follows the limb by a share s and the trunk by the rest. Half way across, any share is
    equally likely: a beta distribution of variance s (1 - s) / 3.
    """
    variance = np.zeros(observed.shape)
    breath = _outward(motion, cells, ("breath",))
    for limb, weight in limb_weights(cells).items():
        with_limb = _outward(motion, cells, (limb,)) / np.maximum(weight, 1e-12)
        variance += (with_limb - breath) ** 2 * weight * (1.0 - weight) / 3.0
    return np.asarray(
        np.sum(variance, axis=0, where=observed) / np.maximum(observed.sum(axis=0), 1)
    )


def _unobserved_breath(motion: BodyMotion, cells: BodyCells, observed: Mask) -> Array:
    """Unknown part of the breath between a cell's last observation and the middle, (C,) mm.

    Up to a half of its displacement along the normals: little after a fraction of a second, since
    pairs observe velocity and acceleration too, most of it long after.
    """
    modes = motion.kind("sway").modes
    decorrelation = 1.0 - modes.values @ modes.middle
    unknown = np.abs(_outward(motion, cells, ("breath",))) * decorrelation[:, None] ** 2
    smallest = np.min(unknown, axis=0, where=observed, initial=np.inf)
    known = np.isfinite(smallest) & modes.middle.any()
    return 0.5 * np.where(known, smallest, 0.0)


def _outward(motion: BodyMotion, cells: BodyCells, kinds: Sequence[str]) -> Array:
    """Displacements along normals by those kinds, from each pair's moment to the middle, (P, C) mm."""
    displacement = motion.displacements(kinds, from_middle=True)[..., :3]
    return np.einsum("pci,ci->pc", displacement, cells.normals)
