"""Where a person's breath shows: on the trunk, in front more than behind."""

from __future__ import annotations

import numpy as np
from scipy.spatial.distance import cdist

from bodyscan.alignment.body_cells import BodyCells, modulated, normal_field, one_each
from bodyscan.alignment.part_names import PARTS, leftward, name_parts
from bodyscan.arrays import Array
from bodyscan.progress import threaded

LENGTH_MM = 80.0
"""Over which a trunk rises alike: a breast, the side of a chest beside an arm. With 110 mm what these
do otherwise than the front at large was left in, up to a third of how far a chest's side went."""
MARKS_MM = 60.0  # from one place of the trunk by which others are told to the next
SURE = 1e-3  # of the largest: what is less is rounding
LEAST = 0.02
"""Of the variance of the largest function; what is less costs unknowns and tells nothing."""
PLACE = 0.35
"""Of how far the front of a trunk rises as one, how much more or less any place of it does."""
SIZES_MM = np.array([0.02, 0.35, 0.5, 0.7, 1.0, 1.4, 2.0, 2.8])
"""Standard deviations over time of where it rises most; a chest or belly rises by 2 to 8 mm at rest,
1.4 of 4."""
# Shares of the stature: breath begins to show above the hips, and no more above the collarbones.
HIPS, WAIST, COLLAR, NECK = 0.47, 0.54, 0.79, 0.86
EVIDENCE = 0.3
"""By so much what was seen of all cells tells one breath from another: neighbouring cells err alike, by
how calibrations bend, so that three count as one."""
SMALL = 0.005
"""Of a breath's variance: what is less than that tells no breath from another, and costs most."""
BEHIND = 0.25
"""Of the front: ribs rise to the sides too, less than half as far, and a back leans on nothing."""


def breath_fields(cells: BodyCells) -> Array:
    """(C, 12, M) displacement fields outwards, of the trunk as one and of its places, smooth over it,
    nothing elsewhere."""
    as_one = breathing(cells)[:, None]
    kept = PLACE * _places(cells.centres, as_one)
    return modulated(normal_field(cells), cells, np.hstack([as_one, kept]))


def _places(centres: Array, as_one: Array) -> Array:
    """(C, M) functions of cells with centres (C, 3), whose products sum to how alike two rise by
    themselves, times as_one (C, 1); those that are next to nothing are left out.

    Straight through the body a trunk's front is far from its back: no way along the skin is needed.
    """
    trunk = np.flatnonzero(as_one)
    if not len(trunk):
        return np.zeros((len(centres), 0))
    marks = trunk[one_each(centres[trunk], MARKS_MM)]
    apart = cdist(centres, centres[marks])
    alike = np.exp(-0.5 * (apart / LENGTH_MM) ** 2)
    values, vectors = np.linalg.eigh(alike[marks])
    sure = values > SURE * values[-1]
    functions = alike @ (vectors[:, sure] / np.sqrt(values[sure])) * as_one
    shown, ways = np.linalg.eigh(functions.T @ functions)
    return np.asarray(functions @ ways[:, shown > LEAST * shown[-1]])


def likely_breath(information: Array, pull: Array, breaths: Array, likely: Array) -> Array:
    """(J, J) covariance of courses' amplitudes: the mean of all breaths (K, J, J) in all sizes, each as
    likely (K,) as it was before, times how well it explains what was seen.

    information (M J, M J), pull (M J,): normal equations of M fields along J courses, whatever else
    moved.
    """
    courses = breaths.shape[1]
    sizes, ways = np.linalg.eigh(breaths)
    main = (sizes > SMALL * sizes[:, -1:]).any(axis=0)
    roots = ways[:, :, main] * np.sqrt(sizes[:, None, main])
    blocks = information.reshape(-1, courses, len(information) // courses, courses)
    count = len(pull) // courses

    def gain(root: Array) -> Array:
        """(S,) of one breath in all sizes: the logarithm of how well it explains what was seen."""
        seen = np.einsum("ai,manb,bj->minj", root, blocks, root, optimize=True)
        sizes, ways = np.linalg.eigh(seen.reshape(2 * (count * root.shape[1],)))
        along = (pull.reshape(-1, courses) @ root).ravel() @ ways
        more = np.maximum(sizes, 0.0) + SIZES_MM[:, None] ** -2.0
        volume = np.log(more * SIZES_MM[:, None] ** 2).sum(axis=1)
        return np.asarray(0.5 * (along**2 / more).sum(axis=1) - 0.5 * volume)

    gains = np.array(threaded(gain, roots, stage="aligning"))
    weights = likely[:, None] * np.exp((gains - gains.max()) * EVIDENCE)
    return np.asarray(np.einsum("kij,ks,s->ij", breaths, weights / weights.sum(), SIZES_MM**2))


def breathing(cells: BodyCells) -> Array:
    """(C,) how far breath may lift each cell, against the front of the trunk."""
    height = cells.centres[:, 2] / cells.centres[:, 2].max()
    left = leftward(cells)
    forward = cells.normals[:, :2] @ np.array([left[1], -left[0]])
    front = BEHIND + (1.0 - BEHIND) * _rising(forward, -0.5, 1.0)
    at_height = _rising(height, HIPS, WAIST) * (1.0 - _rising(height, COLLAR, NECK))
    return np.asarray((name_parts(cells) == PARTS.index("trunk")) * at_height * front)


def _rising(values: Array, low: float, high: float) -> Array:
    """0 below, 1 above, smooth between."""
    t = np.clip((values - low) / (high - low), 0.0, 1.0)
    return np.asarray(t * t * (3.0 - 2.0 * t))
