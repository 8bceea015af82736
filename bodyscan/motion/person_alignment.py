"""Align a person's range images: estimate the motion, and free the poles that were displaced."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bodyscan.alignment.displaced_poles import (
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
    # `TimeFit.name`, if other moments explain the motion far better; those stated were then left out.
    other_times: str = ""


def align_person(
    images: Sequence[RangeImage],
    rig_from_camera: Mapping[str, RigidTransform],
    aligned: Alignment,
    boards: PoseCovariance,
    poles: Mapping[str, str],
    settings: AlignmentSettings,
) -> PersonAlignment:
    """Estimate the person's motion and free displaced poles, in turn.

    images, rig_from_camera, boards, settings: as given to `align`.
    aligned: its result.
    poles: the pole of each pair that is mounted on one.

    Motion and displaced poles can explain each other. So the motion is estimated first as if no pole
    were displaced; what only a displaced pole explains is then freed, and all is repeated. An error
    common to all pairs may also warp what each measured, so that no pole is asked for after it.
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
        found: Displacement | None = None if motion and evidence else search.found
        if found is None and evidence is not None and common_error is None:
            rival, known = motion.times.log_ratio if motion else 0.0, _collect_pairs(displaced)
            found = detect_displacement(evidence, rig_from_camera, poles, known, rival)
        warped = isinstance(common_error, CommonError)  # as by motion within moments
        if found is None and motion is not None and motion.times.name and not warped:
            # Nor is anything displaced that seemed so by these times.
            images = [replace(image, time_ms=None, span_ms=None) for image in images]
            found_anew = align_person(images, rig_from_camera, *start, poles, settings)
            return replace(found_anew, other_times=motion.times.name)
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
        if isinstance(found, ScaleError):
            common_error = found
            for side in _group_by_pole(boards.names, poles):
                boards = free_pairs(boards, side)
        elif isinstance(found, CommonError):
            common_error = found
            basis = build_common_basis(boards.names, rig_from_camera)
            added = basis @ basis.T * 30.0**2  # mm^2, as in `free_pairs`
            boards = PoseCovariance(boards.names, boards.matrix + added)
        else:
            displaced.append(found)
            boards = free_pairs(boards, found.pairs)
        aligned = align(images, rig_from_camera, boards, settings)


def _group_by_pole(names: Collection[str], poles: Mapping[str, str]) -> list[list[str]]:
    """The pairs of each pole; pairs that are on none, one by one."""
    sides: dict[str, list[str]] = {}
    for name in names:
        sides.setdefault(poles.get(name, name), []).append(name)
    return list(sides.values())


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
    if (
        len({poles.get(image.pair, image.pair) for image in images if image.pair not in displaced})
        < 2
    ):
        return DisplacementSearch(None, np.inf)
    moments = {image.pair: image.time_ms for image in images}
    return find_displaced_pole(
        [(_select_connected_motions(rig_from_camera, aligned), moments)], poles, displaced
    )


def _measure_again(
    displaced: Sequence[DisplacedPole], motions: Mapping[str, Array]
) -> tuple[DisplacedPole, ...]:
    """Displacements relative to the poles that were not displaced, once all of them are free.

    What overlaps no longer connect to those keeps the displacement that it was found with.
    """
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
