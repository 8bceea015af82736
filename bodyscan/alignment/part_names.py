"""Which part of a person each cell of the body belongs to, whichever way the person faces."""

from __future__ import annotations

import numpy as np

from bodyscan.alignment.body_cells import BodyCells
from bodyscan.arrays import Array, Indices

PARTS = ("trunk", "head", "left arm", "right arm", "left leg", "right leg")
LEGS = PARTS[-2:]
# Shares of the stature (Drillis and Contini 1966, rounded): where head and legs begin, the least
# distance through the body from the navel to a fingertip, and from there to the shoulder.
NECK, NAVEL, CROTCH, KNEE, TO_FINGERTIP, ARM = 0.86, 0.6, 0.47, 0.29, 0.35, 0.38
FOOT, ANKLE, SHIN = 0.03, 0.05, 0.15


def name_parts(cells: BodyCells) -> Indices:
    """Number (C,) in PARTS of the part each cell belongs to, whichever way the person faces."""
    stature = float(cells.centres[:, 2].max())
    height = cells.centres[:, 2] / stature
    off = cells.centres[:, :2] - np.median(cells.centres[:, :2], axis=0)
    sideways = off @ leftward(cells) / stature
    part = np.where(height > NECK, PARTS.index("head"), PARTS.index("trunk"))
    part[height < CROTCH] = PARTS.index("right leg")
    part[(height < CROTCH) & (sideways > 0.0)] = PARTS.index("left leg")
    navel = int(np.argmin(np.abs(height - NAVEL) + np.abs(sideways)))
    from_navel = cells.distances(np.array([navel]))[0] / stature
    hands = (height > KNEE) & (height < NECK)
    for name, way in (("left arm", sideways), ("right arm", -sideways)):
        tip = int(np.argmax(np.where(hands, way, -np.inf)))
        if from_navel[tip] > TO_FINGERTIP:
            from_tip = cells.distances(np.array([tip]))[0] / stature
            part[from_tip < ARM] = PARTS.index(name)
    return part


def ankles(cells: BodyCells) -> Array:
    """Midpoint of the ankles, (3,) mm; below the middle of the body if no shin was seen."""
    stature = float(cells.centres[:, 2].max())
    shins = cells.centres[:, 2] < SHIN * stature
    low = cells.centres[shins] if shins.any() else cells.centres
    return np.append(low[:, :2].mean(axis=0), ANKLE * stature)


def above_feet(cells: BodyCells) -> Array:
    """(C,): 0 in the feet, 1 above the ankles."""
    height = cells.centres[:, 2] / cells.centres[:, 2].max()
    return np.clip((height - FOOT) / (ANKLE - FOOT), 0.0, 1.0)


def leftward(cells: BodyCells) -> Array:
    """Unit vector (2,) to the subject's left; toes point forward, or without them the rig's x."""
    height = cells.centres[:, 2] / cells.centres[:, 2].max()
    feet, shins = height < FOOT, (height > ANKLE) & (height < SHIN)
    forward = np.array([1.0, 0.0])
    if feet.any() and shins.any():
        toes = cells.centres[feet, :2].mean(axis=0) - cells.centres[shins, :2].mean(axis=0)
        if np.linalg.norm(toes) > 0.01 * cells.centres[:, 2].max():
            forward = toes / np.linalg.norm(toes)
    return np.array([-forward[1], forward[0]])
