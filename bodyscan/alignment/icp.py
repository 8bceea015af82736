"""Align range images where they overlap, with the boards' solution and covariance as prior.

A multiway ICP: find matches between all pairs, then solve for small motions of all of them together
with the prior, so that the ring closes and only what the boards leave open changes. Pairs that
share hardly more than a rim are tied by that rim, with less weight. Pairs without overlap stay
where the boards put them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

import numpy as np

from bodyscan.alignment.matching import Matches
from bodyscan.alignment.overlap_equations import OverlapEquations, motion_covariance, solve_motions
from bodyscan.alignment.overlaps import (
    COARSE,
    OverlapPoints,
    each_overlap,
    match_overlap,
    tied_groups,
)
from bodyscan.alignment.sway_prior import SwayPrior, bound_motions, centre_shifts
from bodyscan.arrays import Array
from bodyscan.geometry.robust import rms
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.geometry.uncertainty import PoseCovariance
from bodyscan.progress import THREADS
from bodyscan.reconstruction.range_image import RangeImage
from bodyscan.settings import AlignmentSettings

Result = TypeVar("Result")

FINE_ROUNDS = 2  # the last rounds use all points
UNKNOWN = 0, float("nan"), float("nan")


@dataclass(frozen=True)
class Overlap:
    """An overlap of two pairs.

    source, target: names of the pairs.
    points: approximate number of points that they share.
    rms_before_mm, rms_after_mm: RMS distance of those before and after alignment.
    expected_mm: RMS distance due to noise alone.
    """

    source: str
    target: str
    points: int
    rms_before_mm: float
    rms_after_mm: float
    expected_mm: float = float("nan")


@dataclass(frozen=True, eq=False)
class Alignment:
    """The result of an alignment.

    rig_from_camera: the aligned poses.
    motion_mm: motion at the body's centre of each pair that overlaps tie to the largest group; how
        far others moved is not observed.
    refused: pairs that would have moved farther than the prior allows, with their motion in sigmas.
    overlaps: all overlaps.
    poses: covariance of the aligned poses, given the prior (boards, and a sway of the size found)
        and the overlaps; None if a pair was refused, or Open3D aligned.
    """

    rig_from_camera: dict[str, RigidTransform]
    motion_mm: dict[str, float]
    refused: dict[str, float]
    overlaps: tuple[Overlap, ...]
    poses: PoseCovariance | None = None

    @property
    def rms_before_mm(self) -> float:
        return _pool_rms([(o.points, o.rms_before_mm) for o in self.overlaps])

    @property
    def rms_after_mm(self) -> float:
        return _pool_rms([(o.points, o.rms_after_mm) for o in self.overlaps])

    @property
    def expected_mm(self) -> float:
        """The value of `rms_after_mm` for noise alone."""
        return _pool_rms([(o.points, o.expected_mm) for o in self.overlaps])


def align(
    images: Sequence[RangeImage],
    rig_from_camera: Mapping[str, RigidTransform],
    prior: PoseCovariance,
    settings: AlignmentSettings,
    *,
    workers: int = THREADS,
) -> Alignment:
    """Find small motions of all range images that bring their overlaps together.

    Each round assumes the sway found by the last one, within the bounds of the settings.
    """
    names = [image.pair for image in images]
    start = [rig_from_camera[name] for name in names]
    sway = SwayPrior.of(settings)
    with ThreadPoolExecutor(workers) as pool:
        clouds = list(pool.map(lambda image: OverlapPoints.of(image, settings.spacing_mm), images))
        coarse = [seen.some(COARSE) for seen in clouds]
        if settings.matching == "open3d":
            from bodyscan.alignment.open3d_registration import register  # Open3D loads for a second

            inner = [seen.inner for seen in clouds]
            motion, left = register(inner, start, names, prior, settings), None
        else:
            motion, left = _register(pool, (coarse, clouds), start, names, prior, settings)
        widest = sway.covariance(names, prior, sway.most)
        motion, refused = bound_motions(names, motion, widest, settings.limit_sigmas)
        moved = [t.retract(m) for t, m in zip(start, motion, strict=True)]
        # Measure both with the same reach, so that they can be compared.
        was, now = (
            _each_overlap(_gap, pool, coarse, placings, settings.least_reach_mm, settings)
            for placings in (start, moved)
        )
    shift = np.linalg.norm(centre_shifts(motion), axis=1).tolist()
    tied = _largest_group(now)
    return Alignment(
        dict(zip(names, moved, strict=True)),
        {name: shift[k] for k, name in enumerate(names) if k in tied},
        refused,
        tuple(
            Overlap(names[i], names[j], COARSE.step * count, was.get((i, j), UNKNOWN)[1], *apart)
            for (i, j), (count, *apart) in now.items()
        ),
        None if left is None or refused else PoseCovariance(tuple(names), left),
    )


def _register(
    pool: ThreadPoolExecutor,
    clouds: tuple[Sequence[OverlapPoints], Sequence[OverlapPoints]],
    start: Sequence[RigidTransform],
    names: Sequence[str],
    prior: PoseCovariance,
    settings: AlignmentSettings,
) -> tuple[Array, Array]:
    """Motions (P, 6), rig frame, by rounds of new matches and one joint step of all pairs; and their
    covariance (6P, 6P).

    clouds: coarse, and fine for the last rounds.
    """
    motion, sway = np.zeros((len(start), 6)), SwayPrior.of(settings)
    reach, scale = settings.reach_mm, 1.0
    equations = partial(OverlapEquations.of, correlated=settings.correlated)
    coarse, fine = clouds
    for left in range(settings.rounds, 0, -1):
        moved = [t.retract(m) for t, m in zip(start, motion, strict=True)]
        taken = fine if left <= FINE_ROUNDS else coarse
        overlaps = _each_overlap(equations, pool, taken, moved, reach, settings)
        known = sway.covariance(names, prior, scale)
        motion = solve_motions(overlaps, motion, known)
        reach, scale = max(reach / 2.0, settings.least_reach_mm), sway.scale(motion)
    return motion, motion_covariance(overlaps, known)


def _each_overlap(
    measure: Callable[[Matches], Result],
    pool: ThreadPoolExecutor,
    clouds: Sequence[OverlapPoints],
    placings: Sequence[RigidTransform],
    reach_mm: float,
    settings: AlignmentSettings,
) -> dict[tuple[int, int], Result]:
    """Measure the matches of every two pairs that have enough of them."""

    def of_two(i: int, j: int) -> Result | None:
        matches = match_overlap(
            clouds[i], clouds[j], placings[i], placings[j], reach_mm, settings.fewest
        )
        return None if matches is None else measure(matches)

    return each_overlap(pool, len(clouds), of_two)


def _largest_group(overlaps: Iterable[tuple[int, int]]) -> set[int]:
    """The largest group of images tied by overlaps; images without any overlap form no group."""
    ties = list(overlaps)
    groups = tied_groups(sorted({image for both in ties for image in both}), ties)
    return max(groups, key=len, default=set())


def _gap(matches: Matches) -> tuple[int, float, float]:
    """Number of matches, their RMS distance, and its expected value by their sigmas, mm."""
    apart, sigma = matches.distances, matches.sigma_mm
    return len(apart), rms(apart), rms(sigma)


def _pool_rms(parts: Sequence[tuple[int, float]]) -> float:
    known = [(points, rms) for points, rms in parts if np.isfinite(rms)]
    total = sum(points for points, _ in known)
    if not total:
        return float("nan")
    return float(np.sqrt(sum(points * rms**2 for points, rms in known) / total))
