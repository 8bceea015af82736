"""Head and arms: each turns as a whole about its joint with the trunk and hardly shifts."""

from __future__ import annotations

import numpy as np

from bodyscan.alignment.body_cells import BodyCells, modulated, rigid_fields
from bodyscan.alignment.part_names import PARTS, name_parts
from bodyscan.arrays import Array

LIMBS = ("head", "left arm", "right arm")
SHIFTS = tuple(f"{limb} shift" for limb in LIMBS)
BORDER_MM = 60.0  # width over which a moving part blends into the rest: a neck, a shoulder


def limb_shares(cells: BodyCells) -> dict[str, Array]:
    """How far each cell goes along with each limb, (C,): 1 on it, 0 on the trunk.

    It fades across the limb's border.
    """
    part = name_parts(cells)
    near = np.exp(-0.5 * (cells.away / BORDER_MM) ** 2)
    total = np.maximum(near.sum(axis=0), 1e-12)
    own = {limb: part[cells.landmarks] == PARTS.index(limb) for limb in LIMBS}
    return {limb: np.minimum((marks @ near) / total, 1.0) for limb, marks in own.items()}


def limb_fields(cells: BodyCells, arm_mm: float) -> dict[str, Array]:
    """Displacement fields (C, 12, 3) of each limb's turn and shift (see `rigid_fields`).

    The joint lies in the middle of the limb's border; limbs that the body does not show have zero
    fields.
    """
    fields = {}
    for (limb, share), shift in zip(limb_shares(cells).items(), SHIFTS, strict=True):
        border = share * (1.0 - share)
        joint = border @ cells.centres / max(border.sum(), 1e-12)
        field = modulated(rigid_fields(cells, joint, arm_mm), cells, share[:, None])
        fields[limb], fields[shift] = field[..., :3], field[..., 3:]
    return fields
