"""Follow a person while pair after pair sees them: one body from many moments.

Alignment places each pair by one rigid motion. A person who breathes or moves an arm needs more:
each pair's surface is carried, cell by cell of the body, to where it was in the middle of the scan.
This is done only for people whose overlaps ask for it; a mannequin stays as aligned.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeVar

import numpy as np

from bodyscan.alignment.body_cells import BodyCells, displaced
from bodyscan.alignment.body_motion import BodyMotion, outward_errors
from bodyscan.alignment.cell_evidence import CellEvidence
from bodyscan.alignment.icp import Alignment
from bodyscan.alignment.limbs import LIMBS, SHIFTS
from bodyscan.alignment.matching import AlignmentPoints, Matches
from bodyscan.alignment.motion_sigmas import cell_sigmas, sigmas_around
from bodyscan.alignment.overlaps import COARSE, OverlapPoints, each_overlap, match_overlap
from bodyscan.alignment.place_evidence import PlaceEvidence
from bodyscan.alignment.sway_prior import SwayPrior, centre_shifts
from bodyscan.arrays import Array, Indices, Mask
from bodyscan.geometry.robust import rms, rms_length
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.geometry.uncertainty import PoseCovariance
from bodyscan.mesh.body import BodyMesh, BreathAt
from bodyscan.progress import THREADS
from bodyscan.reconstruction.range_image import RangeImage
from bodyscan.settings import AlignmentSettings

Result = TypeVar("Result")

SWAYING = ("lean", "sway")
BENDING = (*LIMBS, *SHIFTS, "parts", "breath")
MOVING = (*SWAYING, *BENDING)
ROUNDS = 3  # the last with all points
STILL_MM = 0.1
"""RMS of motion beyond rigid ones; less does no harm, and calibrations bend by half of it."""

NEARER = 0.95
"""If bending does not bring overlaps closer than this share, they are apart because of the pairs'
own calibrations, which bend with place and not with time."""


@dataclass(frozen=True, eq=False)
class MeanBreath:
    """Motion from the middle of the scan to mean breath.

    field: displacements (C, 12) as in `Followed.bends`.
    sigma_mm: standard deviation (C,) along the normals, as it affects a girth there.
    """

    field: Array
    sigma_mm: Array

    def along(self, cells: BodyCells, points: Array, normals: Array) -> tuple[Array, Array]:
        """Displacement and sigma, outwards, (N,) mm each, of points (N, 3) with normals (N, 3)."""
        cell = cells.find_many(points, normals)
        way = displaced(self.field[cell], points - cells.centres[cell])
        return np.sum(way * normals, axis=1), self.sigma_mm[cell]


@dataclass(frozen=True, eq=False)
class Followed:
    """A person's motion, in cells of the body (see `BodyCells`).

    bends: by pair, displacement fields (C, 12) from where the pair's pose puts the surface to where
        it was in the middle of the scan.
    moved: by pair, everything the person moved between its moment and the middle, (P, C, 3) mm.
    seen: which pairs saw which cells, (P, C).
    sigma_mm: sigma of a cell's surface along its normal, from the uncertainty of the motion and of
        the pairs' poses, (C,).
    moment_ms: the middle of the scan; None (the mean of all) if no pair's moment is known.
    breath: None without moments.
    """

    cells: BodyCells
    bends: dict[str, Array]
    moved: Array
    seen: Mask
    sigma_mm: Array
    moment_ms: float | None
    breath: MeanBreath | None = None

    def breathing(self, surface: BodyMesh) -> BodyMesh:
        """With the way to mean breath, where it is known."""
        if self.breath is None:
            return surface
        way, sigma = self.breath.along(
            self.cells, surface.vertices, surface.normals.astype(np.float64)
        )
        return replace(surface, breath=BreathAt(way.astype(np.float32), sigma.astype(np.float32)))


@dataclass(frozen=True, eq=False)
class _View:
    """The points of one pair that take part, and the cell of each."""

    start: RigidTransform
    seen: OverlapPoints
    cell: Indices

    @staticmethod
    def of(start: RigidTransform, image: RangeImage, spacing_mm: float) -> _View:
        seen = OverlapPoints.of(image, spacing_mm)
        return _View(start, seen, np.zeros(len(seen.inner.points), np.int64))

    @property
    def points(self) -> AlignmentPoints:
        return self.seen.inner

    def among(self, cell: Indices) -> _View:
        """The view with each point's cell, without points that lie in none."""
        return replace(self, cell=cell).some(cell >= 0)

    def some(self, chosen: Mask | slice) -> _View:
        return _View(self.start, self.seen.some(chosen), self.cell[chosen].copy())


def follow(
    images: Sequence[RangeImage],
    rig_from_camera: Mapping[str, RigidTransform],
    aligned: Alignment,
    prior: PoseCovariance,
    settings: AlignmentSettings,
    *,
    workers: int = THREADS,
) -> tuple[Alignment, Followed | None, PlaceEvidence | None]:
    """Follow a moving person.

    images, rig_from_camera, prior, settings: as given to `align`.
    aligned: its result.

    Returns the alignment with sway that follows time; the rest of the motion, None with the
    alignment unchanged for a person who stood still or if too little overlaps; and what all this
    says about the pairs' places, None if a pair's moment is unknown, since any sway would explain
    those.
    """
    if not aligned.overlaps or not settings.sway_mm or aligned.refused:
        return aligned, None, None
    names = [image.pair for image in images]
    seconds = [None if image.time_ms is None else 1e-3 * image.time_ms for image in images]
    with ThreadPoolExecutor(workers) as pool:
        views = list(
            pool.map(
                lambda image: _View.of(rig_from_camera[image.pair], image, settings.spacing_mm),
                images,
            )
        )
        there = [aligned.rig_from_camera[name] for name in names]
        views, cells = _in_cells(views, there)
        seen = np.array(
            [np.bincount(view.cell, minlength=len(cells.centres)) > 0 for view in views]
        )
        usual = np.repeat([np.radians(settings.sway_deg), settings.sway_mm], 3)
        boards = SwayPrior(0.0, 0.0, 0.0, 0.0).covariance(names, prior)
        start = BodyMotion.start(cells, seconds, boards, usual)
        solved = _solve(pool, views, (start, cells), seen, settings)
        if solved is None:
            return aligned, None, None
        motion = solved.motion
        if solved.still:
            return aligned, None, _places(names, motion, seconds)
        coarse = [view.some(COARSE) for view in views]
        gaps = _each_overlap(_gap, pool, coarse, (motion, cells), solved.reach_mm, settings)
    placed, places = _placed(aligned, names, views, motion, gaps), _places(names, motion, seconds)
    if placed.rms_after_mm > NEARER * aligned.rms_after_mm and _is_unswayed(motion, seen, settings):
        return aligned, None, places
    followed = Followed(
        cells,
        dict(zip(names, motion.bends(from_middle=True), strict=True)),
        motion.displacements(MOVING, from_middle=True)[..., :3],
        seen,
        cell_sigmas(motion, cells, seen),
        _middle_ms(images),
        _mean_breath(motion, cells) if _middle_ms(images) is not None else None,
    )
    return placed, followed, places


def _in_cells(
    views: Sequence[_View], rig_from_camera: Sequence[RigidTransform]
) -> tuple[list[_View], BodyCells]:
    """The cells of the body that the views show, aligned; and these with the cell of each point."""
    both = [(place, view.points) for place, view in zip(rig_from_camera, views, strict=True)]
    cells, cell = BodyCells.of(
        np.concatenate([place.apply(cloud.points) for place, cloud in both]),
        np.concatenate([place.rotate(cloud.normals) for place, cloud in both]),
    )
    ends = np.cumsum([len(cloud.points) for _, cloud in both])[:-1]
    split = np.split(cell, ends)
    return [view.among(own) for view, own in zip(views, split, strict=True)], cells


@dataclass(frozen=True, eq=False)
class _Solved:
    """A motion, the reach that its last matches had halved, and whether it is none to be taken out."""

    motion: BodyMotion
    reach_mm: float
    still: bool = False


def _solve(
    pool: ThreadPoolExecutor,
    views: Sequence[_View],
    person: tuple[BodyMotion, BodyCells],
    seen: Mask,
    settings: AlignmentSettings,
) -> _Solved | None:
    """In each round matches anew, and the motion that explains them; None where nothing overlaps.
    person: as it starts."""
    motion, cells = person
    asks = partial(CellEvidence.of, centres=cells.centres, correlated=settings.correlated)
    coarse, reach = [view.some(COARSE) for view in views], settings.reach_mm
    for left in range(ROUNDS, 0, -1):
        taken = coarse if left > 1 else views
        said = _each_overlap(asks, pool, taken, (motion, cells), reach, settings)
        if not said:
            return None
        motion = motion.solved(_both_ways(said))
        reach = max(reach / 2.0, settings.least_reach_mm)
        if left == ROUNDS - 1 and _is_unbent(motion, seen) and _is_unswayed(motion, seen, settings):
            return _Solved(motion, reach, still=True)
    return _Solved(motion, reach)


def _places(
    names: Sequence[str], motion: BodyMotion, seconds: Sequence[float | None]
) -> PlaceEvidence | None:
    return None if None in seconds else PlaceEvidence.of(names, motion)


def _middle_ms(images: Sequence[RangeImage]) -> float | None:
    """The middle of the scan as in `Courses`, ms."""
    known = [image.time_ms for image in images if image.time_ms is not None]
    return 0.5 * (min(known) + max(known)) if known else None


def _mean_breath(motion: BodyMotion, cells: BodyCells) -> MeanBreath:
    """Mean breath: the courses have mean zero, where a breath is half way."""
    middle = motion.kind("breath").courses.middle
    field = motion.kind("breath").fields @ motion.of("breath", middle)
    errors = outward_errors(motion, "breath", middle, cells.normals)
    return MeanBreath(field, sigmas_around(errors, cells.centres[:, 2]))


def _each_overlap(
    measure: Callable[[Matches, Indices], Result],
    pool: ThreadPoolExecutor,
    views: Sequence[_View],
    person: tuple[BodyMotion, BodyCells],
    reach_mm: float,
    settings: AlignmentSettings,
) -> dict[tuple[int, int], Result]:
    """Measure the matches of every two pairs with the person as followed so far."""
    motion, cells = person
    placed = [view.start.retract(motion.twist(k)) for k, view in enumerate(views)]
    bends = motion.bends()

    def of_two(i: int, j: int) -> Result | None:
        """Carry the source to where it was when the target was seen, and measure."""
        view = views[i]
        points, away = placed[i].apply(view.points.points), bends[i] - bends[j]
        points += displaced(away[view.cell], points - cells.centres[view.cell])
        source = view.seen.carried(points, placed[i].rotate(view.points.normals))
        here, there = RigidTransform.identity(), placed[j]
        found = match_overlap(source, views[j].seen, here, there, reach_mm, settings.fewest)
        return None if found is None else measure(found, view.cell[found.source])

    return each_overlap(pool, len(views), of_two)


def _both_ways(said: Mapping[tuple[int, int], CellEvidence]) -> dict[tuple[int, int], CellEvidence]:
    """Combine both directions of each overlap: errors of one direction on curves cancel."""
    gathered: dict[tuple[int, int], list[CellEvidence]] = {}
    for (i, j), evidence in said.items():
        one = evidence if i < j else evidence.turned()
        gathered.setdefault((min(i, j), max(i, j)), []).append(one)
    return {both: CellEvidence.total(parts) for both, parts in gathered.items()}


def _is_unbent(motion: BodyMotion, seen: Mask) -> bool:
    """Whether nothing moved that rigid poses of the pairs do not account for as well."""
    return _far(motion, BENDING, seen) < STILL_MM


def _is_unswayed(motion: BodyMotion, seen: Mask, settings: AlignmentSettings) -> bool:
    return _far(motion, SWAYING, seen) < settings.least_sway * settings.sway_mm


def _far(motion: BodyMotion, names: Sequence[str], seen: Mask) -> float:
    """RMS displacement by those kinds, mm."""
    return rms_length(motion.displacements(names, from_middle=True)[seen][:, :3])


def _gap(matches: Matches, cell: Indices) -> float:
    return rms(matches.distances)


def _placed(
    aligned: Alignment,
    names: Sequence[str],
    views: Sequence[_View],
    motion: BodyMotion,
    gaps: Mapping[tuple[int, int], float],
) -> Alignment:
    twists = np.array([motion.twist(k, from_middle=True) for k in range(len(views))])
    shift = np.linalg.norm(centre_shifts(twists), axis=1)
    placed = [view.start.retract(twist) for view, twist in zip(views, twists, strict=True)]
    left = {(names[i], names[j]): rms_mm for (i, j), rms_mm in gaps.items()}
    return replace(
        aligned,
        rig_from_camera=dict(zip(names, placed, strict=True)),
        motion_mm={
            name: mm
            for name, mm in zip(names, shift.tolist(), strict=True)
            if name in aligned.motion_mm
        },
        overlaps=tuple(
            replace(o, rms_after_mm=left.get((o.source, o.target), o.rms_after_mm))
            for o in aligned.overlaps
        ),
    )
