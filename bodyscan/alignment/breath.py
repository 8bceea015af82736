"""Where a person's breath shows: on the trunk, more in front than behind."""

from __future__ import annotations

import numpy as np

from bodyscan.alignment.body_cells import BodyCells, modulated, normal_field
from bodyscan.alignment.part_names import PARTS, leftward, name_parts
from bodyscan.arrays import Array
from bodyscan.progress import threaded

LENGTH_MM = 110.0  # length over which a trunk rises alike: a chest, a belly, a side
LEAST = 0.04
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
    functions = PLACE * cells.alike(LENGTH_MM, LEAST) * as_one
    shown = np.sum(functions**2, axis=0)
    kept = functions[:, shown > LEAST * shown.max()]
    return modulated(normal_field(cells), cells, np.hstack([as_one, kept]))


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
