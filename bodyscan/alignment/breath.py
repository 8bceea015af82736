"""Where a person's breath shows: a trunk swells forward, and to its sides, away from its back."""

from __future__ import annotations

import numpy as np
from scipy.spatial.distance import cdist

from bodyscan.alignment.body_cells import BodyCells, modulated, one_each, rigid_fields
from bodyscan.alignment.part_names import PARTS, leftward, name_parts
from bodyscan.arrays import Array
from bodyscan.progress import map_threads

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
BESIDE = 0.3
"""How far a side goes outwards as the front goes forward: 1 to 2 mm for 3 to 5 at the ribs, next to
nothing at the belly (De Groote et al. 1997, J. Appl. Physiol. 83)."""
EXTENT = (2.0, 98.0)  # percentiles of a trunk's cells: single ones lie beyond
LEAST_TRUNK = (0.1, 0.15)
"""Depth and width as shares of the stature, where less of a trunk was seen; adults' are larger."""


def breath_fields(cells: BodyCells) -> Array:
    """Displacement fields (C, 12, M): of the trunk as one, and of its places forward and sideways.

    A breast, or the edge of the ribs, goes where the chest goes, whichever way its skin faces: how
    far the trunk moves forward is smoother than how far it moves along its normals. The fields are
    zero elsewhere.
    """
    axes = _level_axes(cells)
    level = rigid_fields(cells, np.zeros(3), 1.0)[..., 3:5] @ axes
    both = []
    for k, share in enumerate(_swelling(cells, axes).T[..., None]):
        functions = np.hstack([share, PLACE * _places(cells.centres, share)])
        both.append(modulated(level[..., k : k + 1], cells, functions))
    as_one = sum(own[..., :1] for own in both)
    return np.concatenate([as_one, *(own[..., 1:] for own in both)], axis=2)


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

    gains = np.array(map_threads(gain, roots, stage="aligning"))
    weights = likely[:, None] * np.exp((gains - gains.max()) * EVIDENCE)
    return np.asarray(np.einsum("kij,ks,s->ij", breaths, weights / weights.sum(), SIZES_MM**2))


def breathing(cells: BodyCells) -> Array:
    """How far a breath that carries the front of the trunk by 1 mm carries each cell outwards, (C,)."""
    axes = _level_axes(cells)
    ways = _swelling(cells, axes) @ axes.T
    return np.asarray(np.sum(ways * cells.normals[:, :2], axis=1))


def _swelling(cells: BodyCells, axes: Array) -> Array:
    """How far along `axes` (forward, leftward) each cell goes, (C, 2), as the trunk's front goes
    forward.

    Ribs turn about the spine and a belly swells before it: what lies farther from the back, or from
    the middle, goes farther.
    """
    height = cells.centres[:, 2] / cells.centres[:, 2].max()
    at_height = _rising(height, HIPS, WAIST) * (1.0 - _rising(height, COLLAR, NECK))
    share = at_height * (name_parts(cells) == PARTS.index("trunk"))
    breathes = share > 0.5
    if not breathes.any():
        return np.zeros((len(share), 2))
    places = cells.centres[:, :2] @ axes
    low, high = np.percentile(places[breathes], EXTENT, axis=0)
    deep, wide = np.maximum(high - low, np.multiply(LEAST_TRUNK, cells.centres[:, 2].max()))
    forward = np.clip((places[:, 0] - high[0]) / deep + 1.0, 0.0, 1.0)
    beside = np.clip((places[:, 1] - 0.5 * (low[1] + high[1])) / (0.5 * wide), -1.0, 1.0)
    return share[:, None] * np.stack([forward, BESIDE * beside], axis=1)


def _level_axes(cells: BodyCells) -> Array:
    """Unit vectors forward and to the left of the subject, as columns, (2, 2)."""
    left = leftward(cells)
    return np.array([[left[1], left[0]], [-left[0], left[1]]])


def _rising(values: Array, low: float, high: float) -> Array:
    """0 below `low`, 1 above `high`, smooth between."""
    t = np.clip((values - low) / (high - low), 0.0, 1.0)
    return np.asarray(t * t * (3.0 - 2.0 * t))
