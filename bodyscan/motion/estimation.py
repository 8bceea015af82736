"""Estimate a person's motion between the pairs' captures, and the pairs' poses with it.

Alignment moves each pair by one rigid motion. A person who breathes or moves an arm needs more: each
pair's surface is displaced, cell by cell of the body, to where it was in the middle of the scan.
This is done only if the overlaps require it; a mannequin stays as aligned.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations
from typing import TypeVar

import numpy as np

from bodyscan.alignment.displaced_poles import STILL_MM
from bodyscan.alignment.icp import Alignment
from bodyscan.alignment.matching import Matches, SampledPoints
from bodyscan.alignment.overlaps import COARSE, OverlapPoints, map_overlaps, match_overlap
from bodyscan.alignment.pose_evidence import MIN_LOG_RATIO, PoseEvidence, PostureStep
from bodyscan.alignment.sway_prior import SwayPrior, compute_centre_shifts
from bodyscan.arrays import Array, Indices, Mask
from bodyscan.geometry.linear_gaussian import LinearGaussianSystem
from bodyscan.geometry.robust import compute_rms_length, rms
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.geometry.uncertainty import PoseCovariance
from bodyscan.mesh.body import BodyMesh, BreathAt
from bodyscan.motion.body_cells import BodyCells, evaluate_field
from bodyscan.motion.body_motion import BodyMotion, compute_girth_sigmas, compute_shape_sigmas
from bodyscan.motion.body_parts import LIMBS
from bodyscan.motion.cell_equations import CellEquations
from bodyscan.progress import background, map_threads
from bodyscan.reconstruction.range_image import RangeImage
from bodyscan.settings import AlignmentSettings

Result = TypeVar("Result")

RIGID = ("lean", "sway")
NON_RIGID = (*LIMBS, "parts", "step", "breath")
ROUNDS = 3  # the last with all points


@dataclass(frozen=True, eq=False)
class BreathOffset:
    """Displacement from the middle of the scan to mean breath."""

    field: Array  # (C, 12), see `build_rigid_fields`
    sigma_mm: Array  # standard deviation (C,) along the normals, as it affects a girth there

    def along_normals(self, cells: BodyCells, points: Array, normals: Array) -> tuple[Array, Array]:
        """Displacement and sigma, (N,) mm each, along the normals of points (N, 3)."""
        cell = cells.find_by_groups(points, normals)
        displacement = evaluate_field(self.field[cell], points - cells.centres[cell])
        return np.sum(displacement * normals, axis=1), self.sigma_mm[cell]


@dataclass(frozen=True, eq=False)
class EstimatedMotion:
    """A person's motion, in cells of the body.

    warps: by pair, displacement fields (C, 12) from where the pair's pose puts the surface to where
        it was in the middle of the scan.
    displacements: by pair, of the whole motion between its moment and the middle, (P, C, 3) mm.
    observed: which pairs measured which cells, (P, C).
    sigma_mm: standard deviation of a cell's surface along its normal, from the uncertainty of the
        motion and of the pairs' poses, (C,).
    moment_ms: the middle of the scan; None (the mean of all) if no pair's moment is known.
    breath: without moments it is 0, as uncertain as people breathe; None for no estimate.
    step: displacements (C, 3) mm from the posture while one pole fired to that at other times; None
        without a `PostureStep`.
    """

    cells: BodyCells
    warps: dict[str, Array]
    displacements: Array
    observed: Mask
    sigma_mm: Array
    moment_ms: float | None
    breath: BreathOffset | None = None
    step: Array | None = None

    @property
    def significant(self) -> bool:
        """Whether the motion is larger than its own error; if not, the object is taken as still."""
        seen = self.observed.any(axis=0)
        return compute_rms_length(self.displacements[self.observed]) >= rms(self.sigma_mm[seen])

    def add_breath(self, surface: BodyMesh) -> BodyMesh:
        """Attach each vertex's displacement to mean breath, where it is known."""
        if self.breath is None:
            return surface
        normals = surface.normals.astype(np.float64)
        offset, sigma = self.breath.along_normals(self.cells, surface.vertices, normals)
        breath = BreathAt(offset.astype(np.float32), sigma.astype(np.float32))
        return replace(surface, breath=breath)


@dataclass(frozen=True, eq=False)
class _View:
    """The sampled points of one pair, its initial pose, and the cell of each point."""

    initial: RigidTransform
    sampled: OverlapPoints
    cell: Indices

    @staticmethod
    def from_image(pose: RigidTransform, image: RangeImage, spacing_mm: float) -> _View:
        sampled = OverlapPoints.from_image(image, spacing_mm)
        return _View(pose, sampled, np.zeros(len(sampled.inner.points), np.int64))

    @property
    def points(self) -> SampledPoints:
        return self.sampled.inner

    def select(self, chosen: Mask | slice) -> _View:
        return _View(self.initial, self.sampled.select(chosen), self.cell[chosen].copy())


def estimate_motion(
    images: Sequence[RangeImage],
    rig_from_camera: Mapping[str, RigidTransform],
    aligned: Alignment,
    prior: PoseCovariance,
    settings: AlignmentSettings,
    poles: Mapping[str, str],
    step: PostureStep | None = None,
) -> tuple[Alignment, EstimatedMotion | None, PoseEvidence | None]:
    """Estimate the motion of a person, and the poses of the pairs, from all overlaps.

    images, rig_from_camera, prior, settings: as given to `align`.
    aligned: its result.
    poles: the pole of each pair that is mounted on one.
    step: another posture while one pole fired, to be estimated too.

    Returns the alignment with sway as a function of time; the non-rigid motion, None (and the
    alignment unchanged) for a person who stood still or if too little overlaps; and the evidence on
    pose errors, and on the moments, None if one is unknown: sway would then explain any error.
    """
    if not aligned.overlaps or not settings.sway_mm or aligned.refused:
        return aligned, None, None
    names = [image.pair for image in images]
    seconds = [None if image.time_ms is None else 1e-3 * image.time_ms for image in images]
    sampled = map_threads(
        lambda one: _View.from_image(rig_from_camera[one.pair], one, settings.spacing_mm), images
    )
    poses = [aligned.rig_from_camera[name] for name in names]
    views, cells = _divide_into_cells(sampled, poses)
    observed = np.array(
        [np.bincount(view.cell, minlength=len(cells.centres)) > 0 for view in views]
    )
    sides = [poles.get(name, name) for name in names]
    at_rest = _begin(images, (views, cells), prior, sides, settings)
    if step is not None:
        at_rest = at_rest.with_step(step.kinds, np.isin(names, [*step.pairs]), step.size_mm)
    solution = _solve(views, (at_rest, cells), observed, settings)
    if solution is None:
        return aligned, None, None
    motion = solution.motion
    # What hardly moved says nothing about times: calibrations that disagree look like motion.
    moves = _compute_rms_displacement(motion, (*RIGID, *NON_RIGID), observed) > STILL_MM
    collect_evidence = partial(solution.pose_evidence, names, seconds, sides, moves=moves)
    if solution.negligible:
        return aligned, None, collect_evidence()
    with background() as other:
        evidence = other.submit(collect_evidence)
        moved = _update_alignment(
            aligned, names, views, (motion, cells), solution.reach_mm, settings
        )
        found = _describe_motion(images, motion, cells, observed)
    # Overlaps that motion brings no closer are apart because of the pairs' own calibrations.
    no_closer = moved.rms_after_mm > 0.95 * aligned.rms_after_mm
    still = no_closer and _is_rigid_negligible(motion, observed, settings)
    if still or not found.significant:
        return aligned, None, evidence.result()
    return moved, _add_step(found, motion, step) if step else found, evidence.result()


def _describe_motion(
    images: Sequence[RangeImage], motion: BodyMotion, cells: BodyCells, observed: Mask
) -> EstimatedMotion:
    """Displacements, mm, from each pair's moment to the middle of the scan, with the sigmas of what
    is left in shape and girth, and the offset to mean breath."""
    moment_ms = _find_middle_of_scan(images)
    sigma_mm, girth_sigma_mm = compute_shape_sigmas(motion, cells, observed)
    warps = motion.non_rigid(from_middle=True)
    return EstimatedMotion(
        cells,
        {image.pair: warp for image, warp in zip(images, warps, strict=True)},
        motion.displacements((*RIGID, *NON_RIGID), from_middle=True)[..., :3],
        observed,
        sigma_mm,
        moment_ms,
        _find_offset_to_mean_breath(motion, cells, girth_sigma_mm, timed=moment_ms is not None),
    )


def _add_step(found: EstimatedMotion, motion: BodyMotion, step: PostureStep) -> EstimatedMotion:
    """The other posture, and girths that may be of either if the trunk's shape changed."""
    displaced = (motion.kind("step").fields @ motion.amplitudes_at("step", np.ones(1)))[:, :3]
    breath = found.breath
    if breath is not None and "breath" in step.kinds:
        # Of the posture taken for the person's own, or as far on either side as the other: uniform.
        either = np.abs(np.sum(displaced * found.cells.normals, axis=1)) / np.sqrt(3.0)
        breath = replace(breath, sigma_mm=np.hypot(breath.sigma_mm, either))
    return replace(found, breath=breath, step=displaced)


def _find_middle_of_scan(images: Sequence[RangeImage]) -> float | None:
    """Midway between the first and the last frame, ms; None if no pair's moment is known."""
    ends = [i.span_ms or (i.time_ms, i.time_ms) for i in images if i.time_ms is not None]
    return 0.5 * (min(a for a, _ in ends) + max(b for _, b in ends)) if ends else None


def _divide_into_cells(
    views: Sequence[_View], rig_from_camera: Sequence[RigidTransform]
) -> tuple[list[_View], BodyCells]:
    """Divide the aligned points of all views into cells; returns views with each point's cell, without
    those that are in none."""
    both = [(pose, view.points) for pose, view in zip(rig_from_camera, views, strict=True)]
    cells, cell = BodyCells.from_points(
        np.concatenate([pose.apply(cloud.points) for pose, cloud in both]),
        np.concatenate([pose.rotate(cloud.normals) for pose, cloud in both]),
    )
    ends = np.cumsum([len(cloud.points) for _, cloud in both])[:-1]
    by_view = np.split(cell, ends)
    parts = zip(views, by_view, strict=True)
    return [replace(view, cell=part).select(part >= 0) for view, part in parts], cells


@dataclass(frozen=True, eq=False)
class _Solution:
    """The motion, the next search radius, and whether the motion is negligible.

    projected: of the last step, see `BodyMotion.project`.
    """

    motion: BodyMotion
    reach_mm: float
    projected: Mapping[tuple[int, int], LinearGaussianSystem]
    negligible: bool = False

    def pose_evidence(
        self,
        names: Sequence[str],
        seconds: Sequence[float | None],
        sides: Sequence[str],
        *,
        moves: bool,
    ) -> PoseEvidence | None:
        """Of the pairs of these names, None if a moment is unknown; of other postures as long as no
        step is estimated; of other moments if the person moves, or all is of one, see `fit_times`."""
        stated = [second for second in seconds if second is not None]
        if len(stated) < len(seconds):
            return None
        known = any(kind.name == "step" for kind in self.motion.kinds)
        steps: tuple[tuple[str, ...], ...] = () if known else (("breath",), LIMBS)
        equations = partial(self.motion.step_equations, self.projected)
        postures = {kinds: partial(equations, kinds) for kinds in steps}
        one_moment = bool(np.ptp(stated) < 1e-3)  # s: nobody moves by more than 0.01 mm meanwhile
        undecided = moves or one_moment
        times = self.fit_times(stated, sides, one_moment) if undecided else ("", 0.0)
        clocks = partial(self.fit_clocks, names, stated, sides) if undecided else None
        return PoseEvidence(tuple(names), self.motion.pose_equations(), postures, times, clocks)

    def log_evidence(
        self,
        seconds: Sequence[float | None],
        omitted: Collection[str] = ("parts",),
        without: Indices | tuple[()] = (),
    ) -> float:
        """If the pairs fired at these moments; without some kinds of motion, and some pairs."""
        middle_s = 0.5 * max((second for second in seconds if second is not None), default=0.0)
        person = self.motion.with_times(seconds, middle_s, omitted)
        fields = self.motion.find_fields([kind.name for kind in person.kinds])
        kept = [both for both in self.projected if not {*both} & {*without}]
        projected = {both: self.projected[both].select(fields) for both in kept}
        return person.solve_projected(projected).log_evidence if projected else np.nan

    def fit_times(
        self, stated: Sequence[float], sides: Sequence[str], one_moment: bool
    ) -> tuple[str, float]:
        """By the evidence of the motion: a posture hardly changes within a tenth of a second, and does
        within a second.

        sides: the pole of each pair. The evidence must be the same without any one of them, which may
        be displaced, and without breath: who holds it seems to be scanned within a moment.
        """
        others = [(f"{f:g} x", [f * second for second in stated]) for f in (0.1, 10.0)]
        # Where an order is stated, others also suit poles that are all displaced.
        if one_moment:
            others += [("in another order than", order) for order in _propose_orders(sides)[::2]]
        now, *found = map_threads(self.log_evidence, [stated, *(one for _, one in others)])
        name, other = others[int(np.argmax(found))]
        if max(found) <= now + MIN_LOG_RATIO:
            return "", 0.0
        # With parts: hips that shift are no lean or limb, and would seem to need other times too.
        left: list[tuple[tuple[str, ...], Indices]] = [(("breath",), np.zeros(0, np.int64))]
        left += [((), np.flatnonzero(np.equal(sides, side))) for side in dict.fromkeys(sides)]
        gains = map_threads(
            lambda one: self.log_evidence(other, *one) - self.log_evidence(stated, *one), left
        )
        return (name, max(found) - now) if np.nanmin(gains) > MIN_LOG_RATIO else ("", 0.0)

    def fit_clocks(
        self, names: Sequence[str], stated: Sequence[float], sides: Sequence[str], step: float = 0
    ) -> str:
        """Poles whose moments, all earlier or later, or two pairs whose moments, exchanged, explain the
        motion beyond doubt.

        step: log likelihood ratio of a posture, which only exchanges may beat, no pole's clock.
        """
        lags = () if step else (-0.4, -0.2, 0.2, 0.4)
        tried = [(side, lag) for side in dict.fromkeys(sides) for lag in lags]
        others = [
            (side, np.add(stated, lag * np.equal(sides, side)).tolist()) for side, lag in tried
        ]
        # Exchanges among the five pairs whose own moments fit worst: those of all would take too long.
        unknown = [[*stated[:k], None, *stated[k + 1 :]] for k in range(len(names))]
        suspects = np.sort(np.argsort(map_threads(self.log_evidence, unknown))[-5:]).tolist()
        for a, b in combinations(suspects, 2):
            exchanged = [*stated]
            exchanged[a], exchanged[b] = stated[b], stated[a]
            others.append((f"{names[a]} and {names[b]}", exchanged))
        moments = [stated, *(one for _, one in others)]
        now, *found = map_threads(lambda one: self.log_evidence(one, ()), moments)
        ranked = sorted(zip(found, others, strict=True), reverse=True)
        best = [name for log, (name, _) in ranked if log > max(found) - MIN_LOG_RATIO]
        significant = max(found) > now + step + MIN_LOG_RATIO
        return f"of {' or '.join(dict.fromkeys(best))} other than" if significant else ""


def _begin(
    images: Sequence[RangeImage],
    person: tuple[Sequence[_View], BodyCells],
    prior: PoseCovariance,
    sides: Sequence[str],
    settings: AlignmentSettings,
) -> BodyMotion:
    """The person at rest, seen at the moments stated, or if none is in an order that shows."""
    views, cells = person
    sway = np.repeat([np.radians(settings.sway_deg), settings.sway_mm], 3)
    boards = SwayPrior(0.0, 0.0, 0.0, 0.0).covariance([image.pair for image in images], prior)
    seconds = [None if image.time_ms is None else 1e-3 * image.time_ms for image in images]
    middle_s = 1e-3 * (_find_middle_of_scan(images) or 0.0)
    at_rest = BodyMotion.at_rest(cells, seconds, middle_s, boards, sway)
    if any(second is not None for second in seconds):
        return at_rest
    ordered = _find_order(views, (at_rest, cells), _propose_orders(sides), settings)
    if ordered is None:
        return at_rest
    return BodyMotion.at_rest(cells, ordered, 0.5 * max(ordered), boards, sway)


def _propose_orders(sides: Sequence[str]) -> list[list[float]]:
    """Moments, s, at which pairs on these poles may have fired: one after another as the rig lists
    them, or so on each pole, all poles at once; 0.1 or 0.2 s apart."""
    numbers = list(range(len(sides))), [sides[:k].count(side) for k, side in enumerate(sides)]
    return [[step * k for k in number] for number in numbers if any(number) for step in (0.1, 0.2)]


def _find_order(
    views: Sequence[_View],
    person: tuple[BodyMotion, BodyCells],
    orders: Sequence[Sequence[float]],
    settings: AlignmentSettings,
) -> Sequence[float] | None:
    """The moments that explain the motion best; None if none does beyond doubt.

    A posture hardly changes from a moment to the next, in the right order alone: of a man whose pairs
    fired in turn the log evidence rose by 160, in other orders it fell by thousands.
    """
    coarse = [view.select(COARSE) for view in views]
    projected = _project_overlaps(coarse, person, settings.reach_mm, settings)
    if not projected:
        return None
    solution = _Solution(person[0], settings.reach_mm, projected)
    unknown, *found = map(solution.log_evidence, [[None] * len(views), *orders])
    best = int(np.argmax(found))
    return orders[best] if found[best] > unknown + MIN_LOG_RATIO else None


def _solve(
    views: Sequence[_View],
    person: tuple[BodyMotion, BodyCells],
    observed: Mask,
    settings: AlignmentSettings,
) -> _Solution | None:
    """Match and update the motion in turn; None if nothing overlaps. person: initial state."""
    motion, cells = person
    coarse, reach = [view.select(COARSE) for view in views], settings.reach_mm
    for remaining in range(ROUNDS, 0, -1):
        points = coarse if remaining > 1 else views
        projected = _project_overlaps(points, (motion, cells), reach, settings)
        if not projected:
            return None
        motion = motion.solve_projected(projected, updates=3 if remaining == 1 else 1)
        reach = max(reach / 2.0, settings.min_reach_mm)
        if remaining == ROUNDS - 1:
            # Calibrations warp surfaces by half of 0.1 mm; so little motion does no harm.
            still = _compute_rms_displacement(motion, NON_RIGID, observed) < 0.1
            if still and _is_rigid_negligible(motion, observed, settings):
                return _Solution(motion, reach, projected, negligible=True)
    return _Solution(motion, reach, projected)


def _find_offset_to_mean_breath(
    motion: BodyMotion, cells: BodyCells, girth_sigma_mm: Array, *, timed: bool
) -> BreathOffset:
    """At mean breath the temporal modes, which have zero mean, are zero.

    girth_sigma_mm: (C,) of the shape at the scan's moment.
    """
    fields = motion.kind("breath").fields
    errors = np.einsum("cim,ci->cm", fields[:, :3], cells.normals)
    if motion.breath is None or not timed:
        # Breathed in is farther from the mean than out: 97.5 % of breaths are within 1.96 times 2.2 mm.
        field, errors = np.zeros(fields.shape[:2]), 2.2 * errors
    else:
        field = fields @ motion.breath.at_middle
        eigenvalues, eigenvectors = np.linalg.eigh(motion.breath.covariance)
        errors = errors @ (eigenvectors * np.sqrt(np.maximum(eigenvalues, 0.0)))
    sigma_mm = compute_girth_sigmas(errors, cells.centres, cells.normals)
    return BreathOffset(field, np.hypot(sigma_mm, girth_sigma_mm))


def _project_overlaps(
    views: Sequence[_View],
    person: tuple[BodyMotion, BodyCells],
    reach_mm: float,
    settings: AlignmentSettings,
) -> dict[tuple[int, int], LinearGaussianSystem]:
    """Equations of the motion from each two pairs that overlap, see `BodyMotion.project`."""
    motion, cells = person
    linearize = partial(
        CellEquations.from_matches, centres=cells.centres, correlated=settings.correlated
    )
    gathered: dict[tuple[int, int], list[CellEquations]] = {}
    for (i, j), one in _map_matches(linearize, views, person, reach_mm, settings).items():
        # Added to the other direction's: errors of one direction on curved surfaces cancel.
        gathered.setdefault((min(i, j), max(i, j)), []).append(one if i < j else one.swap())
    return motion.project({both: CellEquations.sum(parts) for both, parts in gathered.items()})


def _map_matches(
    measure: Callable[[Matches, Indices], Result],
    views: Sequence[_View],
    person: tuple[BodyMotion, BodyCells],
    reach_mm: float,
    settings: AlignmentSettings,
) -> dict[tuple[int, int], Result]:
    """Call `measure` with the matches of each two pairs, after the present motion, and their cells."""
    motion, cells = person
    poses = [view.initial.retract(motion.twist(k)) for k, view in enumerate(views)]
    warps = motion.non_rigid()

    def measure_two(i: int, j: int) -> Result | None:
        """Displace the source to where it was at the target's moment, and match."""
        view = views[i]
        points, warp = poses[i].apply(view.points.points), warps[i] - warps[j]
        points += evaluate_field(warp[view.cell], points - cells.centres[view.cell])
        source = view.sampled.with_geometry(points, poses[i].rotate(view.points.normals))
        matches = match_overlap(
            source,
            views[j].sampled,
            RigidTransform.identity(),
            poses[j],
            reach_mm,
            settings.min_matches,
        )
        return None if matches is None else measure(matches, view.cell[matches.source])

    return map_overlaps(len(views), measure_two)


def _is_rigid_negligible(motion: BodyMotion, observed: Mask, settings: AlignmentSettings) -> bool:
    """Whether the whole body moved by less than the smallest sway that is assumed."""
    return _compute_rms_displacement(motion, RIGID, observed) < settings.min_sway * settings.sway_mm


def _compute_rms_displacement(motion: BodyMotion, names: Sequence[str], observed: Mask) -> float:
    """RMS displacement by those kinds, mm."""
    return compute_rms_length(motion.displacements(names, from_middle=True)[observed][:, :3])


def _update_alignment(
    aligned: Alignment,
    names: Sequence[str],
    views: Sequence[_View],
    person: tuple[BodyMotion, BodyCells],
    reach_mm: float,
    settings: AlignmentSettings,
) -> Alignment:
    """Replace poses, displacements of the body's centre, and RMS distances of the overlaps."""
    motion, _ = person
    distances = _map_matches(
        lambda matches, cell: rms(matches.distances),
        [view.select(COARSE) for view in views],
        person,
        reach_mm,
        settings,
    )
    twists = np.array([motion.twist(k, from_middle=True) for k in range(len(views))])
    shifts = np.linalg.norm(compute_centre_shifts(twists), axis=1)
    shift_mm = dict(zip(names, shifts.tolist(), strict=True))
    poses = [view.initial.retract(twist) for view, twist in zip(views, twists, strict=True)]
    rms_mm = {(names[i], names[j]): distance for (i, j), distance in distances.items()}
    return replace(
        aligned,
        rig_from_camera=dict(zip(names, poses, strict=True)),
        motion_mm={name: shift_mm[name] for name in aligned.motion_mm},
        overlaps=tuple(
            replace(o, rms_after_mm=rms_mm.get((o.source, o.target), o.rms_after_mm))
            for o in aligned.overlaps
        ),
    )
