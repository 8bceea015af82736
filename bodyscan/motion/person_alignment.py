"""Align a person's range images: estimate the motion, and free the poles that were displaced."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bodyscan.alignment.displaced_poles import (
    DisplacedPole,
    DisplacementSearch,
    find_displaced_pole,
    free_pairs,
    motions_between,
)
from bodyscan.alignment.icp import Alignment, align
from bodyscan.alignment.pose_evidence import ScaleError, detect_displacement
from bodyscan.arrays import Array
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.geometry.uncertainty import PoseCovariance
from bodyscan.motion.estimation import EstimatedMotion, estimate_motion
from bodyscan.reconstruction.range_image import RangeImage
from bodyscan.settings import AlignmentSettings


@dataclass(frozen=True, eq=False)
class PersonAlignment:
    """A person's aligned range images.

    motion: of a person who moved.
    displaced: poles, or pairs, that were displaced and moved back.
    scale_error: the common displacement outwards, if all poles were displaced.
    search: for further displaced poles.
    """

    alignment: Alignment
    motion: EstimatedMotion | None
    displaced: tuple[DisplacedPole, ...]
    scale_error: ScaleError | None
    search: DisplacementSearch


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
    were displaced; what only a displaced pole explains is then freed, and all is repeated.
    """
    displaced: list[DisplacedPole] = []
    scale_error: ScaleError | None = None
    while True:
        search = _search(images, rig_from_camera, aligned, poles, displaced)
        alignment, motion, evidence = estimate_motion(
            images, rig_from_camera, aligned, boards, settings
        )
        found: DisplacedPole | ScaleError | None = None
        if motion is None or evidence is None:
            found = search.found
        if found is None and evidence is not None and scale_error is None:
            found = detect_displacement(evidence, rig_from_camera, poles, _pairs_of(displaced))
        if found is None:
            if motion is not None:
                # Offsets caused by a tracked head or arm are not pose errors.
                again = _search(images, rig_from_camera, alignment, poles, displaced)
                search = replace(search, offset_mm=again.offset_mm)
            motions = _connected_motions(rig_from_camera, alignment)
            final = _measure_again(displaced, motions)
            return PersonAlignment(alignment, motion, final, scale_error, search)
        if isinstance(found, ScaleError):
            scale_error = found
            for side in _pairs_by_pole(boards.names, poles):
                boards = free_pairs(boards, side)
        else:
            displaced.append(found)
            boards = free_pairs(boards, found.pairs)
        aligned = align(images, rig_from_camera, boards, settings)


def _pairs_by_pole(names: Collection[str], poles: Mapping[str, str]) -> list[list[str]]:
    """The pairs of each pole; pairs that are on none, one by one."""
    sides: dict[str, list[str]] = {}
    for name in names:
        sides.setdefault(poles.get(name, name), []).append(name)
    return list(sides.values())


def _pairs_of(displaced: Sequence[DisplacedPole]) -> frozenset[str]:
    return frozenset[str]().union(*(one.pairs for one in displaced))


def _search(
    images: Sequence[RangeImage],
    rig_from_camera: Mapping[str, RigidTransform],
    aligned: Alignment,
    poles: Mapping[str, str],
    known: Sequence[DisplacedPole],
) -> DisplacementSearch:
    """Search for another displaced pole, as long as a second one remains as reference."""
    displaced = _pairs_of(known)
    if (
        len({poles.get(image.pair, image.pair) for image in images if image.pair not in displaced})
        < 2
    ):
        return DisplacementSearch(None, np.inf)
    moments = {image.pair: image.time_ms for image in images}
    return find_displaced_pole(
        [(_connected_motions(rig_from_camera, aligned), moments)], poles, displaced
    )


def _measure_again(
    displaced: Sequence[DisplacedPole], motions: Mapping[str, Array]
) -> tuple[DisplacedPole, ...]:
    """Displacements relative to the poles that were not displaced, once all of them are free."""
    all_pairs = _pairs_of(displaced)
    return tuple(
        replace(
            DisplacedPole.from_motions(
                one.name,
                one.pairs,
                {
                    name: twist
                    for name, twist in motions.items()
                    if name not in all_pairs - one.pairs
                },
            ),
            all_moved=one.all_moved,
        )
        for one in displaced
    )


def _connected_motions(
    rig_from_camera: Mapping[str, RigidTransform], found: Alignment
) -> dict[str, Array]:
    """Twists of the pairs that overlaps connect."""
    poses = {name: found.rig_from_camera[name] for name in found.motion_mm}
    return motions_between(rig_from_camera, poses)
