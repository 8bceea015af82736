"""Where a person's breath shows: on the trunk, more in front than behind."""

from __future__ import annotations

import numpy as np
from scipy.spatial.distance import cdist

from bodyscan.alignment.body_cells import BodyCells, modulated, normal_field, one_each
from bodyscan.alignment.part_names import PARTS, leftward, name_parts
from bodyscan.arrays import Array
from bodyscan.progress import threaded

LENGTH_MM = 80.0
"""Length over which a trunk rises alike: a breast, the side of a chest beside an arm. With 110 mm, up
to a third of the rise of a chest's side was not followed."""
MARKS_MM = 60.0  # between the places of the trunk whose rises describe all others
SURE = 1e-3  # relative to the largest eigenvalue: less is rounding
LEAST = 0.02
"""Share of the largest function's variance: smaller functions cost unknowns and add nothing."""
PLACE = 0.35
"""Variation of the rise from place to place, relative to the rise of the trunk's front as one."""
SIZES_MM = np.array([0.02, 0.35, 0.5, 0.7, 1.0, 1.4, 2.0, 2.8])
"""Standard deviations over time of the largest rise: a chest or belly rises by 2 to 8 mm at rest,
and 4 mm are a standard deviation of 1.4."""
# Shares of the stature: breath begins above the hips and ends above the collarbones.
HIPS, WAIST, COLLAR, NECK = 0.47, 0.54, 0.79, 0.86
EVIDENCE = 0.3
"""Weight of the cells' evidence for one breath against another: neighbouring cells share errors
from bent calibrations, so that three count as one."""
SMALL = 0.005
"""Share of a breath's variance: with less, directions cannot tell breaths apart, and cost most."""
BEHIND = 0.25
"""Relative to the front: ribs rise to the sides too, less than half as far, and a back is free."""


def breath_fields(cells: BodyCells) -> Array:
    """Displacement fields (C, 12, M) outwards: of the trunk as one, and of its places.

    They are smooth over the trunk and zero elsewhere.
    """
    as_one = breathing(cells)[:, None]
    kept = PLACE * _places(cells.centres, as_one)
    return modulated(normal_field(cells), cells, np.hstack([as_one, kept]))


def _places(centres: Array, as_one: Array) -> Array:
    """Functions (C, M) of cells with centres (C, 3), whose products sum to the correlation of the
    cells' own rises, times as_one (C, 1); negligible ones are left out.

    A trunk's front is far from its back in a straight line too: no distances along the skin are
    needed.
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
    """Covariance (J, J) of a breath's amplitudes: the mean over all breaths in all sizes.

    Each counts by its prior probability times how well it explains what was seen.

    information, pull: normal equations (M J, M J), (M J,) of M fields along J courses, whatever
        else moved.
    breaths: covariances (K, J, J).
    likely: their prior probabilities (K,).
    """
    courses = breaths.shape[1]
    sizes, ways = np.linalg.eigh(breaths)
    main = (sizes > SMALL * sizes[:, -1:]).any(axis=0)
    roots = ways[:, :, main] * np.sqrt(sizes[:, None, main])
    blocks = information.reshape(-1, courses, len(information) // courses, courses)
    count = len(pull) // courses

    def gain(root: Array) -> Array:
        """Log evidence (S,) of one breath in all sizes."""
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
    """How far breath may lift each cell, relative to the front of the trunk, (C,)."""
    height = cells.centres[:, 2] / cells.centres[:, 2].max()
    left = leftward(cells)
    forward = cells.normals[:, :2] @ np.array([left[1], -left[0]])
    front = BEHIND + (1.0 - BEHIND) * _rising(forward, -0.5, 1.0)
    at_height = _rising(height, HIPS, WAIST) * (1.0 - _rising(height, COLLAR, NECK))
    return np.asarray((name_parts(cells) == PARTS.index("trunk")) * at_height * front)


def _rising(values: Array, low: float, high: float) -> Array:
    """0 below `low`, 1 above `high`, smooth between."""
    t = np.clip((values - low) / (high - low), 0.0, 1.0)
    return np.asarray(t * t * (3.0 - 2.0 * t))
