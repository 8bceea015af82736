"""Align a person's range images: estimate the motion, and free the poles that were displaced."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bodyscan.alignment.displaced_poles import (
    STILL_MM,
    DisplacedPole,
    DisplacementSearch,
    compute_motions_between,
    find_displaced_pole,
    free_pairs,
)
from bodyscan.alignment.icp import Alignment, align
from bodyscan.alignment.pose_evidence import (
    CommonError,
    Displacement,
    PostureStep,
    ScaleError,
    build_common_basis,
    detect_displacement,
)
from bodyscan.arrays import Array
from bodyscan.geometry.robust import compute_rms_length
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.geometry.uncertainty import PoseCovariance
from bodyscan.motion.estimation import EstimatedMotion, estimate_motion
from bodyscan.reconstruction.range_image import RangeImage
from bodyscan.settings import AlignmentSettings


@dataclass(frozen=True, eq=False)
class PersonAlignment:
    """A person's aligned range images."""

    alignment: Alignment
    motion: EstimatedMotion | None  # of a person who moved
    displaced: tuple[DisplacedPole, ...]  # poles, or pairs, that were displaced and moved back
    # Of all pairs, if one displacement of them all explains the scan.
    common_error: ScaleError | CommonError | None
    search: DisplacementSearch  # for further displaced poles
    posture: PostureStep | None = None  # another one than at other times, while one pole fired
    # In words, moments that explain the motion far better; those stated were then left out.
    other_times: str = ""


def align_person(
    images: Sequence[RangeImage],
    rig_from_camera: Mapping[str, RigidTransform],
    aligned: Alignment,
    boards: PoseCovariance,
    poles: Mapping[str, str],
    settings: AlignmentSettings,
) -> PersonAlignment:
    """Estimate the person's motion and free what only displaced poles explain, in turn.

    images, rig_from_camera, boards, settings: as given to `align`; aligned: its result.
    poles: the pole of each pair that is mounted on one.

    An error common to all pairs may also warp what each measured: no pole is asked for after it.
    """
    displaced: list[DisplacedPole] = []
    common_error: ScaleError | CommonError | None = None
    posture: PostureStep | None = None
    start = aligned, boards
    while True:
        search = _search(images, rig_from_camera, aligned, poles, displaced)
        alignment, motion, evidence = estimate_motion(
            images, rig_from_camera, aligned, boards, settings, poles, posture
        )
        other = evidence.other_times[0] if evidence else ""
        # A freed pole leaves other moments nothing to explain; within 0.4 s nobody sways by 10 mm.
        near = bool(displaced) and max(one.size_mm for one in displaced) < 10.0
        if evidence and evidence.fit_clocks and near and not other:
            other = evidence.fit_clocks()
        found: Displacement | None = None if evidence and (motion or other) else search.found
        if found is None and evidence is not None and common_error is None and not other:
            found = detect_displacement(evidence, rig_from_camera, poles, _collect_pairs(displaced))
        step = found if isinstance(found, PostureStep) else None
        if step and evidence and evidence.fit_clocks:
            other = evidence.fit_clocks(step.log_ratio)
        # A common error looks like motion too. Nothing is displaced that seemed so by wrong times.
        if found is step and other and not isinstance(common_error, CommonError):
            untimed = [replace(image, time_ms=None, span_ms=None) for image in images]
            anew = align_person(untimed, rig_from_camera, *start, poles, settings)
            moved = anew.motion
            if moved and compute_rms_length(moved.displacements[moved.observed]) > STILL_MM:
                return replace(anew, other_times=other)
            found = step or (None if motion else search.found)
        if found is None:
            if motion is not None:
                # Offsets caused by a tracked head or arm are not pose errors.
                again = _search(images, rig_from_camera, alignment, poles, displaced)
                search = replace(search, offset_mm=again.offset_mm)
            final = _measure_again(displaced, _select_connected_motions(rig_from_camera, alignment))
            return PersonAlignment(alignment, motion, final, common_error, search, posture)
        if isinstance(found, PostureStep):
            posture = found
            continue
        if isinstance(found, DisplacedPole):
            displaced.append(found)
        else:
            common_error = found
        boards = _loosen(boards, found, rig_from_camera, poles)
        aligned = align(images, rig_from_camera, boards, settings)


def _loosen(
    boards: PoseCovariance,
    found: DisplacedPole | ScaleError | CommonError,
    rig_from_camera: Mapping[str, RigidTransform],
    poles: Mapping[str, str],
) -> PoseCovariance:
    """The prior of the poses with what was found free to be estimated."""
    if isinstance(found, DisplacedPole):
        return free_pairs(boards, found.pairs)
    if isinstance(found, CommonError):
        basis = build_common_basis(boards.names, rig_from_camera)
        added = basis @ basis.T * 30.0**2  # mm^2, as in `free_pairs`
        return PoseCovariance(boards.names, boards.matrix + added)
    for side in dict.fromkeys(poles.get(name, name) for name in boards.names):
        boards = free_pairs(boards, [n for n in boards.names if poles.get(n, n) == side])
    return boards


def _collect_pairs(displaced: Sequence[DisplacedPole]) -> frozenset[str]:
    return frozenset[str]().union(*(one.pairs for one in displaced))


def _search(
    images: Sequence[RangeImage],
    rig_from_camera: Mapping[str, RigidTransform],
    aligned: Alignment,
    poles: Mapping[str, str],
    known: Sequence[DisplacedPole],
) -> DisplacementSearch:
    """Search for another displaced pole, as long as a second one remains as reference."""
    displaced = _collect_pairs(known)
    others = [image.pair for image in images if image.pair not in displaced]
    if len({poles.get(pair, pair) for pair in others}) < 2:
        return DisplacementSearch(None, np.inf)
    moments = {image.pair: image.time_ms for image in images}
    return find_displaced_pole(
        [(_select_connected_motions(rig_from_camera, aligned), moments)], poles, displaced
    )


def _measure_again(
    displaced: Sequence[DisplacedPole], motions: Mapping[str, Array]
) -> tuple[DisplacedPole, ...]:
    """Certain displacements relative to the poles that were not displaced, once all are free. What
    overlaps no longer connect to those keeps the displacement that it was found with."""
    displaced = [one for one in displaced if one.certain]
    standing = {name: motions[name] for name in motions.keys() - _collect_pairs(displaced)}
    again = []
    for one in displaced:
        moved = {name: motions[name] for name in motions.keys() & one.pairs}
        if moved and standing:
            measured = DisplacedPole.from_motions(one.name, one.pairs, moved | standing)
            one = replace(measured, all_moved=one.all_moved)
        again.append(one)
    return tuple(again)


def _select_connected_motions(
    rig_from_camera: Mapping[str, RigidTransform], found: Alignment
) -> dict[str, Array]:
    """Twists of the pairs that overlaps connect."""
    poses = {name: found.rig_from_camera[name] for name in found.motion_mm}
    return compute_motions_between(rig_from_camera, poses)
