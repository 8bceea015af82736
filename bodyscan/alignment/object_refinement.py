"""Refine the pairs' poses on a rigid object that they scanned: ICP with the boards as prior."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from bodyscan.alignment.body_parts import PersonMotion
from bodyscan.alignment.icp import Alignment, align
from bodyscan.alignment.together import bring_together
from bodyscan.errors import FailedWork
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.geometry.uncertainty import PoseCovariance
from bodyscan.reconstruction.range_image import RangeImage
from bodyscan.settings import AlignmentSettings

STILL = AlignmentSettings(sway_mm=0.0, sway_deg=0.0)  # a rigid object
SCANNED = AlignmentSettings()  # as a person, who may move
CLOSER = 0.95
"""Share of the overlaps' RMS. Where less is gained, pairs stand as boards put them, and their poses
would follow the bends of their own calibrations: two rigs came out worse by a third and an eighth."""


@dataclass(frozen=True, eq=False)
class ObjectRefinement:
    """The result of refining on an object.

    alignment: what the object's overlaps ask for.
    rig_from_camera: of all pairs; those that saw nothing of it, or would have moved farther than
        the boards allow, stay where they were.
    """

    alignment: Alignment
    rig_from_camera: dict[str, RigidTransform]

    @property
    def better(self) -> bool:
        """Whether the overlaps lie clearly closer together than before."""
        return self.alignment.rms_after_mm < CLOSER * self.alignment.rms_before_mm

    @property
    def lines(self) -> list[str]:
        """Figures before and after, and which pairs moved."""
        found = self.alignment
        said = [
            f"{len(found.overlaps)} overlaps: {found.rms_before_mm:.3f} mm RMS before, "
            f"{found.rms_after_mm:.3f} after"
        ]
        if found.motion_mm:
            farthest = max(sorted(found.motion_mm), key=lambda name: found.motion_mm[name])
            said.append(f"farthest moved: {farthest}, {found.motion_mm[farthest]:.3f} mm")
        said += [
            f"{name} would have moved by {sigmas:.1f} sigmas, more than the boards allow: left as is"
            for name, sigmas in sorted(found.refused.items())
        ]
        return said


def refine_on_object(
    images: Sequence[RangeImage],
    rig_from_camera: Mapping[str, RigidTransform],
    prior: PoseCovariance,
    poles: Mapping[str, str],
) -> ObjectRefinement:
    """Refine the poses of the pairs on an object.

    images: of one object that stood still while all pairs scanned it, background removed.
    poles: the pole of each pair that stands on one.

    Raises FailedWork if no two pairs saw the same part of it, or if it moved.
    """
    found = align(images, rig_from_camera, prior, STILL)
    if not found.overlaps:
        raise FailedWork(
            "no two pairs see the same part of the object",
            remedy="take a larger object, or put it where the pairs look",
        )
    _require_still(images, rig_from_camera, prior, poles)
    return ObjectRefinement(found, dict(rig_from_camera) | found.rig_from_camera)


def _require_still(
    images: Sequence[RangeImage],
    rig_from_camera: Mapping[str, RigidTransform],
    prior: PoseCovariance,
    poles: Mapping[str, str],
) -> None:
    """Raise FailedWork if a scan of these images would follow a motion.

    Overlaps of what moved come closer too, but by putting the pairs wrong.
    """
    aligned = align(images, rig_from_camera, prior, SCANNED)
    together = bring_together(images, rig_from_camera, aligned, prior, poles, SCANNED)
    if together.followed is None:
        return
    parts = PersonMotion.of(together.followed).parts
    most = max(parts, key=lambda part: part.moved_mm, default=None)
    by = f" by up to {most.moved_mm:.1f} mm ({most.name})" if most else ""
    raise FailedWork(
        f"what was scanned moved{by} while the pairs saw it: poses fitted to it would be wrong",
        remedy="scan a mannequin or another rigid object that stands still; people are for `scan`, "
        "which follows them. If it did stand still, a pair has moved: `check-calibration` tells which",
    )
