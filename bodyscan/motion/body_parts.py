"""Parts of a person: which part each cell belongs to, and how head and arms move."""

from __future__ import annotations

import numpy as np

from bodyscan.arrays import Array, Indices
from bodyscan.mesh.body_frame import find_toes
from bodyscan.motion.body_cells import BodyCells, build_rigid_fields, modulate_fields

PARTS = ("trunk", "head", "left arm", "right arm", "left leg", "right leg")
LEGS = PARTS[-2:]
LIMBS = ("head", "left arm", "right arm", "left forearm", "right forearm")
# Shares of the stature (Drillis and Contini 1966, rounded).
NECK, CROTCH = 0.86, 0.47
FOOT, ANKLE, SHIN = 0.03, 0.05, 0.15
FOREARM = 0.25  # from the fingertips


def name_parts(cells: BodyCells) -> Indices:
    """Assign each cell (C,) an index in PARTS, whichever way the person faces."""
    stature = float(cells.centres[:, 2].max())
    height, sideways = _measure_height_and_side(cells)
    part = np.where(height > NECK, PARTS.index("head"), PARTS.index("trunk"))
    part[height < CROTCH] = PARTS.index("right leg")
    part[(height < CROTCH) & (sideways > 0.0)] = PARTS.index("left leg")
    navel = find_navel(cells)
    from_navel = cells.distances(np.array([navel]))[0] / stature  # through the body
    straight = np.linalg.norm(cells.centres - cells.centres[navel], axis=1) / stature
    hands = (height > 0.29) & (height < NECK)  # above the knees
    for name, outward in (("left arm", sideways), ("right arm", -sideways)):
        # From the navel a fingertip is far, by way of the shoulder; an elbow may stick out farther.
        score = 2.0 * from_navel - straight + outward
        tip = int(np.argmax(np.where(hands & (outward > 0.0), score, -np.inf)))
        # Straight is the way to a thigh or a flank.
        if from_navel[tip] > 0.35 or from_navel[tip] > straight[tip] + 0.05:
            from_tip = cells.distances(np.array([tip]))[0] / stature
            # To the shoulder 0.44, less a border's width; from an elbow, if the hand touches, less.
            part[from_tip < min(0.40, from_navel[tip] - 0.16)] = PARTS.index(name)
    return part


def find_navel(cells: BodyCells) -> int:
    """The cell at a navel's height next to the middle of the body."""
    height, sideways = _measure_height_and_side(cells)
    return int(np.argmin(np.abs(height - 0.6) + np.abs(sideways)))


def _measure_height_and_side(cells: BodyCells) -> tuple[Array, Array]:
    """Heights (C,) and distances (C,) to the left of the body's middle, as shares of the stature."""
    stature = float(cells.centres[:, 2].max())
    offsets = cells.centres[:, :2] - np.median(cells.centres[:, :2], axis=0)
    return cells.centres[:, 2] / stature, offsets @ find_leftward(cells) / stature


def find_ankles(cells: BodyCells) -> Array:
    """Midpoint of the ankles, (3,) mm; below the middle of the body if no shin was measured."""
    stature = float(cells.centres[:, 2].max())
    shins = cells.centres[:, 2] < SHIN * stature
    low = cells.centres[shins] if shins.any() else cells.centres
    return np.append(low[:, :2].mean(axis=0), ANKLE * stature)


def weigh_above_feet(cells: BodyCells) -> Array:
    """Weight (C,) of each cell: 0 in the feet, 1 above the ankles."""
    height = cells.centres[:, 2] / cells.centres[:, 2].max()
    return np.clip((height - FOOT) / (ANKLE - FOOT), 0.0, 1.0)


def find_leftward(cells: BodyCells) -> Array:
    """Unit vector (2,) to the subject's left, from the direction of the toes, or else the rig's x."""
    height = cells.centres[:, 2] / cells.centres[:, 2].max()
    feet, shins = height < FOOT, (height > ANKLE) & (height < SHIN)
    forward = np.array([1.0, 0.0])
    toes = find_toes(cells.centres[feet, :2], cells.centres[shins, :2])
    if np.linalg.norm(toes) > 0.01 * cells.centres[:, 2].max():
        forward = toes / np.linalg.norm(toes)
    return np.array([-forward[1], forward[0]])


def compute_limb_weights(cells: BodyCells) -> dict[str, Array]:
    """Share (C,) with which each cell follows each of LIMBS: 1 on it, 0 on the trunk.

    It fades over 60 mm, the width of a neck's or shoulder's border. Forearms follow their arms too.
    """
    part = name_parts(cells)[cells.landmarks]
    kernel = np.exp(-0.5 * (cells.landmark_distances / 60.0) ** 2)
    total = np.maximum(kernel.sum(axis=0), 1e-12)
    members = {limb: part == PARTS.index(limb.replace("forearm", "arm")) for limb in LIMBS}
    from_navel = cells.distances(np.array([find_navel(cells)]))[0]
    for limb in ("left forearm", "right forearm"):
        inside = cells.landmarks[members[limb]]
        if len(inside):
            tip = inside[np.argmax(from_navel[inside])]
            from_tip = cells.distances(np.array([tip]))[0, cells.landmarks]
            members[limb] &= from_tip < FOREARM * cells.centres[:, 2].max()
    return {limb: np.minimum((marks @ kernel) / total, 1.0) for limb, marks in members.items()}


def build_limb_fields(cells: BodyCells, lever_mm: float) -> dict[str, Array]:
    """Displacement fields (C, 12, 3) of each limb's rotation about its joint.

    The joint is the middle of the limb's border; limbs that were not measured have zero fields.
    """
    fields = {}
    for limb, weight in compute_limb_weights(cells).items():
        border = weight * (1.0 - weight)
        joint = border @ cells.centres / max(border.sum(), 1e-12)
        rotations = build_rigid_fields(cells, joint, lever_mm)[..., :3]
        fields[limb] = modulate_fields(rotations, cells, weight[:, None])
    return fields
