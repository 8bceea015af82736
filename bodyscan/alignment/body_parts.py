"""What a followed person did, part by part, in an operator's words."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodyscan.alignment.breath import breathing
from bodyscan.alignment.following import Followed
from bodyscan.alignment.part_names import PARTS, name_parts
from bodyscan.geometry.robust import rms

MOST = 95.0
ONE_WAY = 0.6  # this share of a breath's displacements goes outwards together
SURE_SIGMAS = 4.0
SHOWS = 0.5  # of a breath
NEEDED_MM = 0.3
"""Error left after correction: 2 mm of a girth. Who needs the part better is told to rescan."""


@dataclass(frozen=True)
class PartMotion:
    """How one part of a person moved.

    moved_mm: largest displacement of most of the part from its place in the middle of the scan.
    left_mm: standard deviation of what is left of it, along the surface's normals.
    seen_once: share of the part that a single pair saw, so that no other could show how it moved.
    """

    name: str
    moved_mm: float
    left_mm: float
    seen_once: float

    @property
    def words(self) -> str:
        return f"{self.name} moved by {self.moved_mm:.1f} mm, known to {self.left_mm:.2f}"


@dataclass(frozen=True)
class PersonMotion:
    """How a person moved.

    parts: the parts that were seen, from the trunk outwards.
    breathed_mm: see `tell_breath`.
    moment_ms: the moment everything is carried to, since the scan began; None (the mean of all)
        without times.
    fuller_mm, fuller_sigma_mm: see `tell_fullness`.
    """

    parts: tuple[PartMotion, ...]
    breathed_mm: float | None
    moment_ms: float | None
    fuller_mm: float | None = None
    fuller_sigma_mm: float | None = None

    @staticmethod
    def of(followed: Followed) -> PersonMotion:
        return PersonMotion(
            tell_parts(followed),
            tell_breath(followed),
            followed.moment_ms,
            *(tell_fullness(followed) or (None, None)),
        )

    @property
    def summary(self) -> str:
        """The motion in one line for the operator; empty if no part was seen."""
        if not self.parts:
            return ""
        left = np.sqrt(np.mean([part.left_mm**2 for part in self.parts]))
        said = (
            f"moved {max(part.moved_mm for part in self.parts):.0f} mm while being scanned; "
            f"corrected to {left:.2f} mm"
        )
        loose = [part for part in self.parts if part.left_mm > NEEDED_MM]
        if not loose:
            return said
        named = ", ".join(f"the {part.name} ({part.left_mm:.1f} mm)" for part in loose)
        return f"{said}; repeat if you need {named}"

    @property
    def lines(self) -> tuple[str, ...]:
        """Details for the operator, after the summary."""
        return (*(part.words for part in self.parts), *self.beside_parts)

    @property
    def beside_parts(self) -> tuple[str, ...]:
        """What the parts have in common: the breath."""
        breath = (
            "breath could not be told from other motion"
            if self.breathed_mm is None
            else f"breathed by {self.breathed_mm:.1f} mm, carried to one moment"
        )
        return (breath, *self._fullness)

    @property
    def _fullness(self) -> tuple[str, ...]:
        if self.fuller_mm is None or self.fuller_sigma_mm is None:
            return ()
        side = "before" if self.fuller_mm > 0 else "behind"
        return (
            f"chest and belly stood {abs(self.fuller_mm):.1f} mm {side} their place at mean breath, "
            f"known to {self.fuller_sigma_mm:.1f}: girths are given at mean breath",
        )


def tell_parts(followed: Followed) -> tuple[PartMotion, ...]:
    """Motions of the parts that were seen, from the trunk outwards."""
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
                rms(followed.sigma_mm[here]),
                float(np.mean(seen.sum(axis=0) == 1)),
            )
        )
    return tuple(found)


def tell_breath(followed: Followed) -> float | None:
    """Rise of the trunk, mm, from the emptiest to the fullest that a pair saw, where it rose most.

    None if what bent most did not rise all over, or by no more than its uncertainty.
    """
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


def tell_fullness(followed: Followed) -> tuple[float, float] | None:
    """Mean offset of the trunk's front before its place at mean breath, mm, and its sigma.

    None without moments, or without a trunk.
    """
    breathes = breathing(followed.cells) > SHOWS
    if followed.breath is None or not breathes.any():
        return None
    normals = followed.cells.normals[breathes]
    way = np.sum(followed.breath.field[breathes, :3] * normals, axis=1)
    # What is uncertain is the course of the breath, which is common to all of the front.
    return -float(np.mean(way)), rms(followed.breath.sigma_mm[breathes])
