"""Find shapes that no freely standing person has: somebody who lies, or things that are carried.

A bag or a backpack is measured as exactly as skin, and nothing in the images tells it from a body.
But bodies change slowly with height, and chests are wider than deep. Anything else raises a
question, no more: skirts end abruptly too, and were meant to be scanned.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, pairwise

import numpy as np

from bodyscan.arrays import Array
from bodyscan.mesh.body import BodyMesh
from bodyscan.mesh.slices import (
    SHORTEST_GAP_MM,
    Loop,
    Run,
    height_ranges,
    joined,
    loops_at,
    runs_of,
)
from bodyscan.verdict import Grade

STEP = 1.0 / 54.0
"""of the height: 30 mm of an adult."""
LOW, HIGH = 0.28, 0.78
"""of the height: from the knees, above swelling calves, to the armpits, below narrowing
shoulders."""
SOON = 0.21
"""Logarithm of the ratio of neighbouring sections' areas: 0.09 to 0.17 under arms and breasts and
along thighs; 0.25 at the top of a bag at the hip, 0.5 at that of a box."""
CHEST = 0.66, 0.75
DEEP = 1.0
"""Depth over width of a chest between the arms: 0.65 to 0.75 on average, 0.9 for a barrel chest."""
ALIKE = 0.5
"""Section of the smaller leg relative to the larger one."""
NARROW = 0.5
"""Where filling joins the thighs: chord over arc of a leg that is cut there. Half of a round trunk has
2 / pi, a thigh 0.2."""
FLAT = 0.8
"""Height over the largest horizontal extent: 1 with arms held out."""
LIMB_MM2 = 1500.0
HAND_MM2 = 6000.0
"""A fist with its thumb. Hanging hands begin abruptly, between two heights; no bag is as small."""
NECK = 0.86
"""of the height: a backpack ends below."""
MEASURED = 0.6
"""of a section's outline: one closed by filling may be of any size."""


@dataclass(frozen=True, eq=False)
class _Section:
    share: float
    height_mm: float
    loops: Sequence[Loop]

    @property
    def area_mm2(self) -> float:
        return sum(loop.area_mm2 for loop in self.loops)


@dataclass(frozen=True)
class Load:
    """Range of heights above the floor, mm, where the trunk's outline holds more than a body."""

    low_mm: float
    high_mm: float


def odd_proportions(mesh: BodyMesh) -> Iterator[tuple[Grade, str]]:
    """A question for each feature that no freely standing person has."""
    top, across = _extents(mesh)
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


def find_loads(mesh: BodyMesh) -> tuple[Load, ...]:
    """Loads of a standing person: where the trunk's outline suddenly grows, and deep chests.

    The first reach up to where the outline shrinks again, or to the neck; the second over the
    heights where a chest is deeper than wide.
    """
    top, across = _extents(mesh)
    if top < FLAT * across:
        return ()
    sections = list(_sections(mesh, top))
    trunk = sections[_crotch(sections) + 1 :]
    found: list[Load] = []
    begins: float | None = None
    for below, above in pairwise(trunk):
        own = _change(_trunk_of(below), _trunk_of(above))
        # Arms that join the trunk change only its outline, and a bag in a hand changes all others.
        if begins is None and min(own, _change(below, above)) > SOON:
            begins = below.height_mm
        elif own < -SOON and (begins is not None or _change(below, above) < -SOON):
            found.append(Load(trunk[0].height_mm if begins is None else begins, above.height_mm))
            begins = None
    if begins is not None:
        found.append(Load(begins, NECK * top))
    deep = [one for one in _deep_chest(trunk) if _is_deep(one)]
    if deep:
        flat = [one.height_mm for one in trunk if len(one.loops) == 3 and not _is_deep(one)]
        lower = [height for height in flat if height < deep[0].height_mm]
        higher = [height for height in flat if height > deep[-1].height_mm]
        ends = max(lower, default=trunk[0].height_mm), min(higher, default=NECK * top)
        found.append(Load(*ends))
    return tuple(found)


def _extents(mesh: BodyMesh) -> tuple[float, float]:
    """Height, and largest horizontal extent, mm."""
    across = float(np.ptp(mesh.vertices[:, :2], axis=0).max())
    return float(mesh.vertices[:, 2].max()), across


def _sections(mesh: BodyMesh, top: float) -> Iterator[_Section]:
    low, high = height_ranges(mesh.vertices, mesh.faces)
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
    """Sudden changes along the legs, and from above the crotch (one itself) to the armpits."""
    crotch = _crotch(sections)
    steps = {
        0.5 * (below.height_mm + above.height_mm): abs(_change(below, _without_hands(above, below)))
        for part in (sections[:crotch], sections[crotch + 1 :])
        for below, above in pairwise(part)
    }
    sudden = {height: step for height, step in steps.items() if step > SOON}
    if sudden:
        worst = max(sudden, key=lambda height: sudden[height])
        yield (
            "usable",
            f"the body's section changes by {np.expm1(sudden[worst]):.0%} at once at {worst:.0f} mm: a "
            "bag or something else that is carried, a bent arm or leg, a skirt? Girths of a trunk that "
            "hold it are those of `trunk and load`",
        )


def _crotch(sections: Sequence[_Section]) -> int:
    """Number of the lowest section that is not through two legs."""
    return next((k for k, one in enumerate(sections) if not _on_two_legs(one)), len(sections))


def _trunk_of(section: _Section) -> _Section:
    return replace(section, loops=section.loops[:1])


def _change(below: _Section, above: _Section) -> float:
    """Logarithm of the ratio of areas, upper to lower, per step in height.

    Sections in between may be missing if they were not measured.
    """
    heights = max(round((above.share - below.share) / STEP), 1)
    return float(np.log(above.area_mm2 / below.area_mm2)) / heights


def _without_hands(above: _Section, below: _Section) -> _Section:
    """The section without loops as small as hands that were not there below."""
    there = len(below.loops)
    more = [loop for loop in above.loops[there:] if loop.area_mm2 > HAND_MM2]
    return replace(above, loops=(*above.loops[:there], *more))


def _on_two_legs(section: _Section) -> bool:
    loops = section.loops
    apart = len(loops) > 1 and loops[1].area_mm2 > ALIKE * loops[0].area_mm2
    return apart or _joined_by_filling(loops[0])


def _joined_by_filling(loop: Loop) -> bool:
    """Whether an outline goes round two legs, between which filled surface lies in front and
    behind."""
    runs = runs_of(loop, SHORTEST_GAP_MM)
    gaps = [k for k, run in enumerate(runs) if not run.measured]
    for one, other in combinations(gaps, 2):
        legs = runs[one + 1 : other], (*runs[other + 1 :], *runs[:one])
        if all(leg and _is_cut_narrowly(loop, leg) for leg in legs):
            small, large = sorted(joined(loop, leg).area_mm2 for leg in legs)
            if small > ALIKE * large:
                return True
    return False


def _is_cut_narrowly(loop: Loop, runs: Sequence[Run]) -> bool:
    arc = sum(loop.lengths[run.segments].sum() for run in runs)
    chord = loop.segments[runs[0].first, 0] - loop.segments[runs[-1].last, 1]
    return bool(np.linalg.norm(chord) < NARROW * arc)


def _chest(sections: Sequence[_Section]) -> Iterator[tuple[Grade, str]]:
    deep = _deep_chest(sections)
    if deep:
        ratio = float(np.median([_depth_over_width(one.loops) for one in deep]))
        yield (
            "usable",
            f"the chest is {ratio:.2f} times as deep as wide: a backpack, or a child that is carried? "
            "Girths that hold it are those of `trunk and load`",
        )


def _deep_chest(sections: Sequence[_Section]) -> list[_Section]:
    """Sections of a chest deeper than wide, between two arms, which show the sideways axis."""
    chest = [one for one in sections if CHEST[0] <= one.share <= CHEST[1] and len(one.loops) == 3]
    ratios = [_depth_over_width(one.loops) for one in chest]
    return chest if ratios and float(np.median(ratios)) > DEEP else []


def _is_deep(section: _Section) -> bool:
    return _depth_over_width(section.loops) > DEEP


def _depth_over_width(loops: Sequence[Loop]) -> float:
    trunk, one, other = loops
    side = one.centre - other.centre
    side = side / np.linalg.norm(side)
    points: Array = trunk.segments[:, 0]
    return float(np.ptp(points @ [-side[1], side[0]]) / np.ptp(points @ side))
