"""Bring all range images of a person together: follow the person, free the poles that moved."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bodyscan.alignment.following import Followed, follow
from bodyscan.alignment.icp import Alignment, align
from bodyscan.alignment.place_evidence import SizeStep, find_off
from bodyscan.alignment.pole_steps import (
    PoleStep,
    StepSearch,
    find_steps,
    loosened,
    motions_between,
)
from bodyscan.arrays import Array
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.geometry.uncertainty import PoseCovariance
from bodyscan.reconstruction.range_image import RangeImage
from bodyscan.settings import AlignmentSettings


@dataclass(frozen=True, eq=False)
class Together:
    """A person's range images brought together.

    followed: the motion of a person who moved.
    shifted: poles, or pairs, that stand off and were freed.
    size: the common step outwards, if all poles were freed.
    search: for what else moved by itself.
    """

    alignment: Alignment
    followed: Followed | None
    shifted: tuple[PoleStep, ...]
    size: SizeStep | None
    search: StepSearch


def bring_together(
    images: Sequence[RangeImage],
    rig_from_camera: Mapping[str, RigidTransform],
    aligned: Alignment,
    boards: PoseCovariance,
    poles: Mapping[str, str],
    settings: AlignmentSettings,
) -> Together:
    """Follow the person and free what stands off, in turn.

    images, rig_from_camera, boards, settings: as given to `align`.
    aligned: its result.
    poles: the pole of each pair that stands on one.

    A person's motion and poles that stand off can explain each other. So the person is followed
    first as if no pole had moved; what that leaves for poles alone to explain is freed, and all is
    done again.
    """
    steps: list[PoleStep] = []
    size: SizeStep | None = None
    while True:
        search = _search(images, rig_from_camera, aligned, poles, steps)
        alignment, followed, places = follow(images, rig_from_camera, aligned, boards, settings)
        off: PoleStep | SizeStep | None = None
        if followed is None or places is None:
            off = search.step
        if off is None and places is not None and size is None:
            off = find_off(places, rig_from_camera, poles, _pairs(steps))
        if off is None:
            if followed is not None:
                # What pairs stand off by for a head or an arm that was followed is not their own.
                again = _search(images, rig_from_camera, alignment, poles, steps)
                search = replace(search, own_mm=again.own_mm)
            motions = _tied_motions(rig_from_camera, alignment)
            return Together(alignment, followed, _measured_again(steps, motions), size, search)
        if isinstance(off, SizeStep):
            size = off
            for side in _sides(boards.names, poles):
                boards = loosened(boards, side)
        else:
            steps.append(off)
            boards = loosened(boards, off.pairs)
        aligned = align(images, rig_from_camera, boards, settings)


def _sides(names: Collection[str], poles: Mapping[str, str]) -> list[list[str]]:
    """The pairs of each pole; pairs that stand on none, one by one."""
    sides: dict[str, list[str]] = {}
    for name in names:
        sides.setdefault(poles.get(name, name), []).append(name)
    return list(sides.values())


def _pairs(steps: Sequence[PoleStep]) -> frozenset[str]:
    return frozenset[str]().union(*(step.pairs for step in steps))


def _search(
    images: Sequence[RangeImage],
    rig_from_camera: Mapping[str, RigidTransform],
    aligned: Alignment,
    poles: Mapping[str, str],
    known: Sequence[PoleStep],
) -> StepSearch:
    """Search for what else moved by itself; one pole stays, or all would have moved."""
    freed = _pairs(known)
    if len({poles.get(image.pair, image.pair) for image in images if image.pair not in freed}) < 2:
        return StepSearch(None, np.inf)
    moments = {image.pair: image.time_ms for image in images}
    return find_steps([(_tied_motions(rig_from_camera, aligned), moments)], poles, freed)


def _measured_again(
    steps: Sequence[PoleStep], motions: Mapping[str, Array]
) -> tuple[PoleStep, ...]:
    """How far each stands off from those that did not move, now that all were free to."""
    off = _pairs(steps)
    return tuple(
        replace(
            PoleStep.of(
                step.name,
                step.pairs,
                {name: at for name, at in motions.items() if name not in off - step.pairs},
            ),
            all_moved=step.all_moved,
        )
        for step in steps
    )


def _tied_motions(
    rig_from_camera: Mapping[str, RigidTransform], found: Alignment
) -> dict[str, Array]:
    """Motions of the pairs that overlaps tie."""
    placed = {name: found.rig_from_camera[name] for name in found.motion_mm}
    return motions_between(rig_from_camera, placed)
