"""Head and arms, which turn and shift each as a whole, against the trunk."""

from __future__ import annotations

import numpy as np

from bodyscan.alignment.body_cells import BodyCells, modulated, rigid_fields
from bodyscan.alignment.part_names import PARTS, name_parts
from bodyscan.arrays import Array

LIMBS = ("head", "left arm", "right arm")
BORDER_MM = 60.0  # over which what moves passes into what does not: a neck, a shoulder


def limb_fields(cells: BodyCells, arm_mm: float) -> dict[str, Array]:
    """By limb, (C, 12, 6) displacement fields: its rigid motion about its own middle (see
    `rigid_fields`), smooth over its border; nothing of one that the body does not show."""
    part = name_parts(cells)
    near = np.exp(-0.5 * (cells.away / BORDER_MM) ** 2)
    fields = {}
    for name in LIMBS:
        own = part == PARTS.index(name)
        share = (own[cells.landmarks] @ near) / np.maximum(near.sum(axis=0), 1e-12)
        middle = cells.centres[own].mean(axis=0) if own.any() else np.zeros(3)
        fields[name] = modulated(rigid_fields(cells, middle, arm_mm), cells, share[:, None])
    return fields
