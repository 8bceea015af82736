"""What a followed person did, part by part, as an operator would say it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodyscan.alignment.body_cells import BodyCells
from bodyscan.alignment.following import Followed
from bodyscan.arrays import Array, Indices

PARTS = ("trunk", "head", "left arm", "right arm", "left leg", "right leg")
# Shares of the stature (Drillis and Contini 1966, rounded): where head and legs begin, how far it is
# through the body from the navel to a fingertip at least, and from there to the shoulder.
NECK, NAVEL, CROTCH, KNEE, TO_FINGERTIP, ARM = 0.86, 0.6, 0.47, 0.29, 0.35, 0.38
FOOT, ANKLE, SHIN = 0.03, 0.05, 0.15
MOST = 95.0
ONE_WAY = 0.6  # of a breath's displacements goes outwards together
SURE_SIGMAS = 4.0


@dataclass(frozen=True)
class PartMotion:
    """moved_mm: how far most of a part was carried at most, against where it was in the middle of the
    scan.  left_mm: standard deviation of what is left of that, along the surface's normals.
    seen_once: share of it that a single pair saw, so that no other could tell how it had moved."""

    name: str
    moved_mm: float
    left_mm: float
    seen_once: float

    @property
    def words(self) -> str:
        return f"{self.name} moved by {self.moved_mm:.1f} mm, known to {self.left_mm:.2f}"


@dataclass(frozen=True)
class PersonMotion:
    """How each part moved that was seen, from the trunk outwards; breathed_mm: see `tell_breath`.
    moment_ms: since the scan began, as of which all is; None (the mean of all) without times."""

    parts: tuple[PartMotion, ...]
    breathed_mm: float | None
    moment_ms: float | None

    @staticmethod
    def of(followed: Followed) -> PersonMotion:
        return PersonMotion(tell_parts(followed), tell_breath(followed), followed.moment_ms)

    @property
    def lines(self) -> tuple[str, ...]:
        """For the operator."""
        breath = (
            "breath could not be told from other motion"
            if self.breathed_mm is None
            else f"breathed by {self.breathed_mm:.1f} mm, carried to one moment"
        )
        return (*(part.words for part in self.parts), breath)


def tell_parts(followed: Followed) -> tuple[PartMotion, ...]:
    """Of the parts that were seen, from the trunk outwards."""
    part = name_parts(followed.cells)
    found = []
    for number, name in enumerate(PARTS):
        here = (part == number) & followed.seen.any(axis=0)
        if not here.any():
            continue
        seen = followed.seen[:, here]
        moved = np.where(seen, np.linalg.norm(followed.moved[:, here], axis=2), 0.0)
        found.append(
            PartMotion(
                name,
                float(np.percentile(moved.max(axis=0), MOST)),
                float(np.sqrt(np.mean(followed.sigma_mm[here] ** 2))),
                float(np.mean(seen.sum(axis=0) == 1)),
            )
        )
    return tuple(found)


def tell_breath(followed: Followed) -> float | None:
    """mm, between the fullest and the emptiest trunk that a pair saw, where it rose most; None if
    what bent most did not rise all over, or no more than is uncertain."""
    here = name_parts(followed.cells) == PARTS.index("trunk")
    if not here.any():
        return None
    outwards = np.einsum(
        "pci,ci->pc",
        np.array(list(followed.bends.values()))[:, here, :3],
        followed.cells.normals[here],
    )
    course, size, mode = np.linalg.svd(outwards - outwards.mean(axis=0), full_matrices=False)
    rise = float(np.ptp(course[:, 0]) * size[0] * np.percentile(np.abs(mode[0]), MOST))
    one_way = abs(np.mean(mode[0])) > ONE_WAY * np.mean(np.abs(mode[0]))
    sure = rise > SURE_SIGMAS * float(np.median(followed.sigma_mm[here]))
    return rise if one_way and sure else None


def name_parts(cells: BodyCells) -> Indices:
    """(C,) number in PARTS of the part that each cell belongs to, whichever way the person faces."""
    stature = float(cells.centres[:, 2].max())
    height = cells.centres[:, 2] / stature
    off = cells.centres[:, :2] - np.median(cells.centres[:, :2], axis=0)
    sideways = off @ _leftward(cells, height) / stature
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


def _leftward(cells: BodyCells, height: Array) -> Array:
    """(2,) to the subject's left: toes point forward, and who stands on none faces the rig's x."""
    feet, shins = height < FOOT, (height > ANKLE) & (height < SHIN)
    forward = np.array([1.0, 0.0])
    if feet.any() and shins.any():
        toes = cells.centres[feet, :2].mean(axis=0) - cells.centres[shins, :2].mean(axis=0)
        if np.linalg.norm(toes) > 0.01 * cells.centres[:, 2].max():
            forward = toes / np.linalg.norm(toes)
    return np.array([-forward[1], forward[0]])
