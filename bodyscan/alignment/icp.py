"""Multiway point-to-plane ICP of range images, with the calibration's poses and covariance as prior.

Each round matches all pairs of images and solves for the poses of all of them jointly, so that the
ring closes and only what the calibration leaves open changes. Images without overlap keep their
calibrated poses.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

import numpy as np

from bodyscan.alignment.matching import Matches
from bodyscan.alignment.overlaps import (
    COARSE,
    OverlapPoints,
    compute_motion_covariance,
    linearize,
    map_overlaps,
    match_overlap,
    solve_motions,
)
from bodyscan.alignment.sway_prior import SwayPrior, compute_centre_shifts, reject_large_motions
from bodyscan.arrays import Array
from bodyscan.geometry.robust import rms
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.geometry.uncertainty import PoseCovariance
from bodyscan.progress import map_threads
from bodyscan.reconstruction.range_image import RangeImage
from bodyscan.rig.rig import find_connected_groups
from bodyscan.settings import AlignmentSettings

Result = TypeVar("Result")


@dataclass(frozen=True)
class Overlap:
    """An overlap of two pairs."""

    # source, target: names of the pairs.
    source: str
    target: str
    points: int  # approximate number of matched points
    # rms_before_mm, rms_after_mm: their RMS distance before and after alignment.
    rms_before_mm: float
    rms_after_mm: float
    expected_mm: float = float("nan")  # RMS distance due to noise alone


@dataclass(frozen=True, eq=False)
class Alignment:
    """The result of an alignment.

    rig_from_camera: the aligned poses.
    motion_mm: displacement at the body's centre of each pair in the largest group connected by
        overlaps; the displacement of others is not observed.
    refused: pairs that would have moved farther than the prior allows, with their motion in sigmas.
    covariance: posterior, of the aligned poses; None if a pair was refused, or Open3D aligned.
    """

    rig_from_camera: dict[str, RigidTransform]
    motion_mm: dict[str, float]
    refused: dict[str, float]
    overlaps: tuple[Overlap, ...]
    covariance: PoseCovariance | None = None

    @property
    def rms_before_mm(self) -> float:
        return _pool_rms([(o.points, o.rms_before_mm) for o in self.overlaps])

    @property
    def rms_after_mm(self) -> float:
        return _pool_rms([(o.points, o.rms_after_mm) for o in self.overlaps])

    @property
    def expected_mm(self) -> float:
        """Expected `rms_after_mm` from noise alone."""
        return _pool_rms([(o.points, o.expected_mm) for o in self.overlaps])


def align(
    images: Sequence[RangeImage],
    rig_from_camera: Mapping[str, RigidTransform],
    prior: PoseCovariance,
    settings: AlignmentSettings,
) -> Alignment:
    """Align range images by small rigid motions that minimize the distances in their overlaps.

    rig_from_camera, prior: calibrated poses and their covariance, to which the subject's sway is
        added. Each round assumes a sway of the size that the last one found, within the bounds of
        the settings.
    """
    names = [image.pair for image in images]
    start = [rig_from_camera[name] for name in names]
    sway = SwayPrior.from_settings(settings)
    clouds = map_threads(lambda one: OverlapPoints.from_image(one, settings.spacing_mm), images)
    coarse = [cloud.select(COARSE) for cloud in clouds]
    if settings.matching == "open3d":
        from bodyscan.alignment.open3d_registration import register  # Open3D loads for a second

        inner = [cloud.inner for cloud in clouds]
        motion, covariance = register(inner, start, names, prior, settings), None
    else:
        motion, covariance = _register((coarse, clouds), start, names, prior, settings)
    widest = sway.covariance(names, prior, sway.max_scale)
    motion, refused = reject_large_motions(names, motion, widest, settings.limit_sigmas)
    moved = [t.retract(m) for t, m in zip(start, motion, strict=True)]

    def measure(matches: Matches) -> tuple[int, float, float]:
        """Number of matches, their RMS distance, and the RMS expected from their sigmas, mm."""
        return len(matches.distances), rms(matches.distances), rms(matches.sigma_mm)

    # Both with the same reach, so that they can be compared.
    reach_mm = settings.min_reach_mm
    before, after = (_map_matches(measure, coarse, at, reach_mm, settings) for at in (start, moved))
    shift = np.linalg.norm(compute_centre_shifts(motion), axis=1).tolist()
    connected = _find_largest_group(after)
    unknown = 0, np.nan, np.nan
    return Alignment(
        dict(zip(names, moved, strict=True)),
        {name: shift[k] for k, name in enumerate(names) if k in connected},
        refused,
        tuple(
            Overlap(
                names[i], names[j], COARSE.step * count, before.get((i, j), unknown)[1], *rms_mm
            )
            for (i, j), (count, *rms_mm) in after.items()
        ),
        None if covariance is None or refused else PoseCovariance(tuple(names), covariance),
    )


def _register(
    clouds: tuple[Sequence[OverlapPoints], Sequence[OverlapPoints]],
    start: Sequence[RigidTransform],
    names: Sequence[str],
    prior: PoseCovariance,
    settings: AlignmentSettings,
) -> tuple[Array, Array]:
    """Estimate the twists (P, 6), rig frame, of all pairs, and their covariance (6P, 6P).

    clouds: coarse, and fine ones for the last two rounds.
    """
    motion, sway = np.zeros((len(start), 6)), SwayPrior.from_settings(settings)
    reach, scale = settings.reach_mm, 1.0
    measure = partial(linearize, correlated=settings.correlated)
    coarse, fine = clouds
    for remaining in range(settings.rounds, 0, -1):
        moved = [t.retract(m) for t, m in zip(start, motion, strict=True)]
        points = fine if remaining <= 2 else coarse
        overlaps = _map_matches(measure, points, moved, reach, settings)
        covariance = sway.covariance(names, prior, scale)
        motion = solve_motions(overlaps, motion, covariance)
        reach, scale = max(reach / 2.0, settings.min_reach_mm), sway.scale(motion)
    return motion, compute_motion_covariance(overlaps, covariance)


def _map_matches(
    measure: Callable[[Matches], Result],
    clouds: Sequence[OverlapPoints],
    poses: Sequence[RigidTransform],
    reach_mm: float,
    settings: AlignmentSettings,
) -> dict[tuple[int, int], Result]:
    """Call `measure` with the matches of each ordered pair of images that overlap."""

    def measure_two(i: int, j: int) -> Result | None:
        matches = match_overlap(
            clouds[i], clouds[j], poses[i], poses[j], reach_mm, settings.min_matches
        )
        return None if matches is None else measure(matches)

    return map_overlaps(len(clouds), measure_two)


def _find_largest_group(overlaps: Iterable[tuple[int, int]]) -> set[int]:
    """The largest connected group of images; images without any overlap form none."""
    edges = list(overlaps)
    groups = find_connected_groups(sorted({image for both in edges for image in both}), edges)
    return max(groups, key=len, default=set())


def _pool_rms(parts: Sequence[tuple[int, float]]) -> float:
    """RMS of several groups of (points, RMS), without those whose RMS is not known."""
    known = [(points, rms) for points, rms in parts if np.isfinite(rms)]
    total = sum(points for points, _ in known)
    if not total:
        return float("nan")
    return float(np.sqrt(sum(points * rms**2 for points, rms in known) / total))
