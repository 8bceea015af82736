"""Where a person's breath shows: on the trunk, in front more than behind."""

from __future__ import annotations

import numpy as np

from bodyscan.alignment.body_cells import BodyCells, modulated, normal_field
from bodyscan.alignment.part_names import PARTS, leftward, name_parts
from bodyscan.arrays import Array

LENGTH_MM = 110.0  # over which a trunk rises alike: a chest, a belly, a side
LEAST = 0.04
# Shares of the stature: breath begins to show above the hips, and no more above the collarbones.
HIPS, WAIST, COLLAR, NECK = 0.47, 0.54, 0.79, 0.86
BEHIND = 0.25
"""Of the front: ribs rise to the sides too, less than half as far, and a back leans on nothing."""


def breath_fields(cells: BodyCells) -> Array:
    """(C, 12, M) displacement fields outwards, smooth over the trunk, nothing elsewhere."""
    functions = cells.alike(LENGTH_MM, LEAST) * breathing(cells)[:, None]
    shown = np.sum(functions**2, axis=0)
    return modulated(normal_field(cells), cells, functions[:, shown > LEAST * shown.max()])


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
