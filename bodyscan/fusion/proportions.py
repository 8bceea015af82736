"""What no person who stands by himself is shaped like: who lies, and things that are carried.

A bag or a backpack is measured as exactly as skin, and nothing that cameras see tells it from a body.
But bodies change slowly with height and are wider than deep at the chest. What is beyond that is asked
about, and no more: skirts end at once too, and were meant to be scanned.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from bodyscan.arrays import Array
from bodyscan.mesh.body import BodyMesh
from bodyscan.mesh.slices import Loop, loops_at
from bodyscan.verdict import Grade

STEP = 1.0 / 54.0
"""of the height: 30 mm of an adult"""
LOW, HIGH = 0.28, 0.78
"""of the height: from the knees, above swelling calves, to the armpits, below narrowing shoulders"""
SOON = 0.21
"""Logarithm of the section's area over that of the next height: under arms and breasts, and along
thighs, it is 0.09 to 0.17; the top of a bag at the hip is 0.25, that of a box 0.5."""
CHEST = 0.66, 0.75
DEEP = 1.0
"""Depth over width of a chest between the arms: 0.65 to 0.75 of average people, 0.9 of a barrel."""
ALIKE = 0.5
"""of the larger leg's section, that of the other"""
FLAT = 0.8
"""Height over the farthest that it reaches to the side: arms held out make it 1"""
LIMB_MM2 = 1500.0
MEASURED = 0.6
"""of a section's outline: where fillings close it, it may be of any size"""


@dataclass(frozen=True, eq=False)
class _Section:
    share: float
    height_mm: float
    loops: Sequence[Loop]

    @property
    def area_mm2(self) -> float:
        return sum(loop.area_mm2 for loop in self.loops)


def odd_proportions(mesh: BodyMesh) -> Iterator[tuple[Grade, str]]:
    """A question for each thing that no standing person by himself is shaped like."""
    top = float(mesh.vertices[:, 2].max())
    across = float(np.ptp(mesh.vertices[:, :2], axis=0).max())
    if top < FLAT * across:
        yield (
            "usable",
            f"it reaches {across:.0f} mm to the side and {top:.0f} mm up: does the person lie, or bend?"
            " Girths are of level sections",
        )
        return
    sections = list(_sections(mesh, top))
    yield from _changes(sections)
    yield from _chest(sections)


def _sections(mesh: BodyMesh, top: float) -> Iterator[_Section]:
    heights = mesh.vertices[mesh.faces, 2]
    low, high = heights.min(axis=1), heights.max(axis=1)
    for share in np.arange(LOW, HIGH, STEP).tolist():
        level = share * top
        near = (low < level) & (high >= level)
        every = loops_at(mesh.vertices, mesh.faces[near], level, mesh.filled[near])
        loops = [loop for loop in every if loop.area_mm2 > LIMB_MM2]
        if loops and _measured(loops):
            yield _Section(share, level, loops)


def _measured(loops: Sequence[Loop]) -> bool:
    lengths = [loop.girth_mm for loop in loops]
    return bool(np.average([loop.measured_share for loop in loops], weights=lengths) > MEASURED)


def _changes(sections: Sequence[_Section]) -> Iterator[tuple[Grade, str]]:
    """Along the legs, and from above where they join, which is a step by itself, to the armpits;
    between neighbours that were measured."""
    crotch = next((k for k, one in enumerate(sections) if not _on_two_legs(one)), len(sections))
    steps = {
        0.5 * (below.height_mm + above.height_mm): abs(np.log(above.area_mm2 / below.area_mm2))
        for part in (sections[:crotch], sections[crotch + 1 :])
        for below, above in pairwise(part)
        if above.share - below.share < 1.5 * STEP
    }
    sudden = {height: step for height, step in steps.items() if step > SOON}
    if sudden:
        worst = max(sudden, key=lambda height: sudden[height])
        yield (
            "usable",
            f"the body's section changes by {np.expm1(sudden[worst]):.0%} at once at {worst:.0f} mm: a "
            "bag or something else that is carried, a bent arm or leg, a skirt? Girths hold it",
        )


def _on_two_legs(section: _Section) -> bool:
    loops = section.loops
    return len(loops) > 1 and loops[1].area_mm2 > ALIKE * loops[0].area_mm2


def _chest(sections: Sequence[_Section]) -> Iterator[tuple[Grade, str]]:
    """Between two arms, which say which way is sideways."""
    ratios = [
        _depth_over_width(one.loops)
        for one in sections
        if CHEST[0] <= one.share <= CHEST[1] and len(one.loops) == 3
    ]
    deep = float(np.median(ratios)) if ratios else 0.0
    if deep > DEEP:
        yield (
            "usable",
            f"the chest is {deep:.2f} times as deep as wide: a backpack, or a child that is carried? "
            "Girths hold it",
        )


def _depth_over_width(loops: Sequence[Loop]) -> float:
    trunk, one, other = loops
    side = one.centre - other.centre
    side = side / np.linalg.norm(side)
    points: Array = trunk.segments[:, 0]
    return float(np.ptp(points @ [-side[1], side[0]]) / np.ptp(points @ side))
