"""Steps where the surfaces of two pairs meet, separated from noise.

Alignment looks only a few millimetres far, and does not see what it leaves out: a pair off by more
than that overlaps with nothing, or with something that is not the same spot. Here pairs are
compared nearly up to their rims and over centimetres, and judged by the median of every patch,
which noise hardly moves.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from bodyscan.alignment.matching import (
    SEAM_RIM_PX,
    AlignmentPoints,
    Matches,
    alignment_points,
    match_projected,
)
from bodyscan.alignment.overlaps import tied_groups
from bodyscan.alignment.pole_steps import moving_alone
from bodyscan.arrays import Array, Indices
from bodyscan.geometry.robust import SIGMAS_PER_MEDIAN
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.progress import THREADS
from bodyscan.reconstruction.range_image import RangeImage

SPACING_MM = 3.0
REACH_MM = 40.0
"""A pole that is farther off shares no surface any more; an arm is farther from the trunk."""
PATCH_MM = 40.0
"""A limb's width: anything narrower affects no girth."""
FEWEST = 8
"""matches in a patch."""
CORRELATED = 5.0
"""neighbouring matches that count as one, because they share their errors."""
MEDIAN_SIGMA = 1.2533
"""Sigma of a median over that of a mean."""
LEAST_SHARE = 0.01
"""of everything that was measured: a pair that saw less affects no girth."""
FAR = 1 << 12
"""More patches than from one end of any volume to the other."""


@dataclass(frozen=True, eq=False)
class Seam:
    """What two pairs both saw, by patches: distances (N,) mm and their sigmas (N,)."""

    pairs: tuple[str, str]
    apart_mm: Array
    sigma_mm: Array

    @property
    def step_mm(self) -> float:
        return typical_step([self])


def typical_step(seams: Sequence[Seam]) -> float:
    """Step that three of four patches do not exceed, less what noise alone would give, mm.

    One patch in four may show something else, such as hair or a hand that moved.
    """
    apart = np.concatenate([seam.apart_mm for seam in seams])
    sigma = np.concatenate([seam.sigma_mm for seam in seams])
    return float(np.sqrt(max(np.percentile(apart**2 - sigma**2, 75.0), 0.0)))


@dataclass(frozen=True)
class Misfit:
    """A pole or a pair that stands `step_mm` off where its surfaces meet the others'."""

    name: str
    step_mm: float


@dataclass(frozen=True, eq=False)
class SeamReport:
    """The seams of a scan.

    groups: see `find_misfits`.
    untied: groups of pairs that share no surface with the largest, so their place is not confirmed.
    """

    seams: tuple[Seam, ...]
    groups: Mapping[str, frozenset[str]]
    untied: tuple[tuple[str, ...], ...]


def judge_seams(
    images: Sequence[RangeImage],
    rig_from_camera: Mapping[str, RigidTransform],
    poles: Mapping[str, str],
) -> SeamReport:
    """Find the seams of a scan.

    images: cleaned.
    poles: the pole of each pair that stands on one.
    """
    seams = find_seams(images, rig_from_camera)
    names = [image.pair for image in images]
    groups = moving_alone(names, poles)
    seen = {image.pair: np.count_nonzero(image.valid) for image in images}
    enough = [name for name in names if seen[name] > LEAST_SHARE * sum(seen.values())]
    return SeamReport(seams, groups, _untied(enough, seams))


def find_seams(
    images: Sequence[RangeImage],
    rig_from_camera: Mapping[str, RigidTransform],
) -> tuple[Seam, ...]:
    """Seams of every two pairs that saw the same surface, after alignment; images: cleaned."""
    with ThreadPoolExecutor(THREADS) as pool:
        seen = list(pool.map(lambda im: alignment_points(im, SPACING_MM, SEAM_RIM_PX), images))
        found = pool.map(lambda two: _seam(two[0], two[1], rig_from_camera), combinations(seen, 2))
        return tuple(seam for seam in found if len(seam.apart_mm))


def find_misfits(
    seams: Sequence[Seam], groups: Mapping[str, frozenset[str]], limit_mm: float
) -> tuple[Misfit, ...]:
    """The fewest pairs without which all others keep to `limit_mm`, worst first.

    groups: what may have moved by itself, poles and single pairs, by name.
    """
    found: list[Misfit] = []
    while _worst_step(groups, seams) > limit_mm:
        left = {name: _without(group, seams) for name, group in groups.items()}
        steps = {name: _step_around(group, seams) for name, group in groups.items()}
        worst = min(
            (name for name in groups if steps[name] > limit_mm),
            key=lambda n: (max(_worst_step(groups, left[n]), limit_mm), len(groups[n]), -steps[n]),
        )
        found.append(Misfit(worst, steps[worst]))
        seams = left[worst]
    return tuple(sorted(found, key=lambda misfit: -misfit.step_mm))


def _untied(names: Sequence[str], seams: Sequence[Seam]) -> tuple[tuple[str, ...], ...]:
    shared = [seam.pairs for seam in seams if set(seam.pairs) <= set(names)]
    groups = sorted(tied_groups(names, shared), key=lambda group: (-len(group), min(group)))
    return tuple(tuple(sorted(group)) for group in groups[1:])


def _without(group: frozenset[str], seams: Sequence[Seam]) -> list[Seam]:
    return [seam for seam in seams if not group.intersection(seam.pairs)]


def _worst_step(groups: Mapping[str, frozenset[str]], seams: Sequence[Seam]) -> float:
    return max((_step_around(group, seams) for group in groups.values()), default=0.0)


def _step_around(group: frozenset[str], seams: Sequence[Seam]) -> float:
    around = [seam for seam in seams if len(group.intersection(seam.pairs)) == 1]
    return typical_step(around) if around else 0.0


def _seam(
    one: AlignmentPoints, other: AlignmentPoints, rig_from_camera: Mapping[str, RigidTransform]
) -> Seam:
    here, there = rig_from_camera[one.image.pair], rig_from_camera[other.image.pair]
    ways = (
        match_projected(one, other, here, there, REACH_MM),
        match_projected(other, one, there, here, REACH_MM),
    )
    parts = [_patches(matches) for matches in ways]
    apart, sigma = (np.concatenate(part) for part in zip(*parts, strict=True))
    return Seam((one.image.pair, other.image.pair), apart, sigma)


def _patches(matches: Matches) -> tuple[Array, Array]:
    """Median distances of patches, and their sigmas from the scatter of the distances."""
    x, y, z = np.floor(matches.points / PATCH_MM).astype(np.int64).T
    _, number, count = np.unique((x * FAR + y) * FAR + z, return_inverse=True, return_counts=True)
    middle = _medians(matches.distances, number, count)
    scatter = SIGMAS_PER_MEDIAN * _medians(
        np.abs(matches.distances - middle[number]), number, count
    )
    sigma = MEDIAN_SIGMA * scatter / np.sqrt(np.maximum(count / CORRELATED, 1.0))
    enough = count >= FEWEST
    return np.abs(middle[enough]), sigma[enough]


def _medians(values: Array, number: Indices, count: Indices) -> Array:
    """Median of the values of each number, counted from 0."""
    rising = np.argsort(values)
    # There are few patches, and 16-bit numbers are sorted in one pass.
    few = number[rising].astype(np.min_scalar_type(len(count)))
    ordered = values[rising[np.argsort(few, kind="stable")]]
    return ordered[np.cumsum(count) - count + count // 2]
