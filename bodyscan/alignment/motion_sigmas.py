"""How well a person's motion is known: what it leaves unknown of where each cell of the body was."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import sparse

from bodyscan.alignment.body_cells import BodyCells
from bodyscan.alignment.body_motion import BodyMotion, observed
from bodyscan.alignment.limbs import SHIFTS, limb_shares
from bodyscan.alignment.part_names import LEGS, PARTS, name_parts
from bodyscan.alignment.sway_prior import BODY_CENTRE
from bodyscan.arrays import Array, Mask

BLEND_MM = 60.0
RING_MM = 20.0  # band of heights in one girth: less than a cell's size

UNSEEN = 0.5
"""Share of a place's motion by breath since a pair saw it that is unknown long after. A pole's
pairs show place, speed and its change, so soon after next to nothing is missing; a second later
a fifth is. (Of people simulated by ray casting, trunks err by 0.8 of their sigmas with it.)"""


def cell_sigmas(motion: BodyMotion, cells: BodyCells, seen: Mask) -> Array:
    """Sigma (C,) mm along the normals of the shape, not counting motions of the whole.

    Computed at the landmarks, between which it changes slowly.
    """
    pair, mark = np.nonzero(seen[:, cells.landmarks])
    there = cells.landmarks[mark]
    rows = np.concatenate(
        [
            observed(motion, k, there[pair == k], cells.normals[there[pair == k]])
            for k in np.unique(pair)
        ]
    )
    off, normals = cells.centres[there] - BODY_CENTRE, cells.normals[there]
    whole = np.linalg.qr(np.hstack([np.cross(off, normals), normals]))[0]
    rows -= whole @ (whole.T @ rows)
    # A point is the mean of what all pairs saw of it.
    views = np.bincount(mark, minlength=len(cells.landmarks))
    shape = len(views), len(mark)
    means = sparse.csr_array((1.0 / views[mark], (mark, np.arange(len(mark)))), shape=shape) @ rows
    # Legs stand on the floor: what overlaps do not ask of them, they did not do.
    stands = np.isin(name_parts(cells)[cells.landmarks], [PARTS.index(leg) for leg in LEGS])
    mean = np.sum((means @ motion.covariance) * means, axis=1)
    others = means[~stands]
    mean[~stands] = np.sum((others @ motion.doubted()) * others, axis=1)
    mean += (UNSEEN * _breath_unseen(motion, cells, seen)[cells.landmarks]) ** 2
    near = np.exp(-0.5 * (cells.away / BLEND_MM) ** 2) * (views > 0)[:, None]
    by_landmarks = mean @ near / np.maximum(near.sum(axis=0), 1e-12)
    return np.sqrt(by_landmarks + _border_variance(motion, cells, seen))


def _border_variance(motion: BodyMotion, cells: BodyCells, seen: Mask) -> Array:
    """Variance (C,) mm^2 along the normals of how far a limb takes its border along.

    There skin goes by a share s with the limb and by the rest with the trunk that breathes. Half way
    across, any share is as likely; the beta distribution that says so has the variance s (1 - s) / 3.
    """
    variance = np.zeros(seen.shape)
    breath = _outwards(motion, cells, ("breath",))
    for (limb, share), shift in zip(limb_shares(cells).items(), SHIFTS, strict=True):
        with_limb = _outwards(motion, cells, (limb, shift)) / np.maximum(share, 1e-12)
        variance += (with_limb - breath) ** 2 * share * (1.0 - share) / 3.0
    return np.asarray(np.sum(variance, axis=0, where=seen) / np.maximum(seen.sum(axis=0), 1))


def _breath_unseen(motion: BodyMotion, cells: BodyCells, seen: Mask) -> Array:
    """How far breath carried each cell to the middle since it was seen, (C,) mm along normals.

    Weighted by how little that moment tells about the middle; of several moments the most telling.
    """
    moments = motion.kind("sway").courses
    apart = 1.0 - moments.values @ moments.middle
    far = np.abs(_outwards(motion, cells, ("breath",))) * apart[:, None] ** 2
    least = np.min(far, axis=0, where=seen, initial=np.inf)
    told = np.isfinite(least) & moments.middle.any()
    return np.where(told, least, 0.0)


def _outwards(motion: BodyMotion, cells: BodyCells, kinds: Sequence[str]) -> Array:
    """Displacements by those kinds, from each pair's moment to the middle, outwards, (P, C) mm."""
    moved = motion.displacements(kinds, from_middle=True)[..., :3]
    return np.einsum("pci,ci->pc", moved, cells.normals)


def sigmas_around(errors: Array, height: Array) -> Array:
    """Standard deviations (C,) mm of errors (C, n), counting only what cells at one height share.

    The rest does not change a girth. height: (C,) mm.
    """
    near = np.exp(-0.5 * ((height[:, None] - height) / RING_MM) ** 2)
    own = np.linalg.norm(errors, axis=1)
    return own * np.linalg.norm(near @ errors, axis=1) / np.maximum(near @ own, 1e-12)
