"""Measure the overlaps of every two range images."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import permutations
from typing import TypeVar

from bodyscan.alignment.matching import (
    RIM_PX,
    SEAM_RIM_PX,
    AlignmentPoints,
    Matches,
    match_projected,
    points_within_rims,
)
from bodyscan.arrays import Array, Mask
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.reconstruction.range_image import RangeImage

Result = TypeVar("Result")
Name = TypeVar("Name", int, str)

COARSE = slice(None, None, 4)
"""The points used in early rounds; all of them are used only in the last ones."""


@dataclass(frozen=True, eq=False)
class OverlapPoints:
    """The points of one range image that take part.

    inner: those of its inner part.
    whole: the same points nearly up to its rims, for images with which it shares nothing more.
    """

    inner: AlignmentPoints
    whole: AlignmentPoints

    @staticmethod
    def of(image: RangeImage, spacing_mm: float) -> OverlapPoints:
        return OverlapPoints(*points_within_rims(image, spacing_mm, RIM_PX, SEAM_RIM_PX))

    def some(self, chosen: Mask | slice) -> OverlapPoints:
        return OverlapPoints(self.inner.some(chosen), self.whole.some(chosen))

    def carried(self, points: Array, normals: Array) -> OverlapPoints:
        """The same points at other places and with other normals, (N, 3) each."""
        inner, whole = (
            replace(part, points=points, normals=normals) for part in (self.inner, self.whole)
        )
        return OverlapPoints(inner, whole)


def match_overlap(
    source: OverlapPoints,
    target: OverlapPoints,
    rig_from_source: RigidTransform,
    rig_from_target: RigidTransform,
    reach_mm: float,
    fewest: int,
) -> Matches | None:
    """Match the inner parts as `match_projected` does, or else everything up to the rims.

    Rims are used if the inner parts share less than `fewest` spots, and get less weight; None if
    that is too little too.
    """
    there = rig_from_source, rig_from_target, reach_mm
    matches = match_projected(source.inner, target.inner, *there)
    if len(matches.distances) < fewest:
        matches = match_projected(source.whole, target.whole, *there).of_seam
    return matches if len(matches.distances) >= fewest else None


def each_overlap(
    pool: ThreadPoolExecutor, count: int, of_two: Callable[[int, int], Result | None]
) -> dict[tuple[int, int], Result]:
    """Results for each of `count` images as source and each other as target, where there is one.

    Both directions are used, so that errors of one direction on curves cancel.
    """
    every_two = list(permutations(range(count), 2))
    found = zip(every_two, pool.map(lambda both: of_two(*both), every_two), strict=True)
    return {both: said for both, said in found if said is not None}


def tied_groups(names: Iterable[Name], ties: Iterable[tuple[Name, Name]]) -> list[set[Name]]:
    """Groups of names that ties join, directly or through others; the untied are alone.

    In the order of each group's first name.
    """
    group = {name: {name} for name in names}
    for one, other in ties:
        joined = group[one] | group[other]
        group |= dict.fromkeys(joined, joined)
    groups: list[set[Name]] = []
    for own in group.values():
        if own not in groups:
            groups.append(own)
    return groups
