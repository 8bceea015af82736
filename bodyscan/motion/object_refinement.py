"""Refine the pairs' poses on a scanned rigid object: ICP with the calibration as prior."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from bodyscan.alignment.icp import Alignment, align
from bodyscan.errors import FailedWork
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.geometry.uncertainty import PoseCovariance
from bodyscan.motion.person_alignment import align_person
from bodyscan.motion.person_motion import PersonMotion
from bodyscan.reconstruction.range_image import RangeImage
from bodyscan.settings import AlignmentSettings


@dataclass(frozen=True, eq=False)
class ObjectRefinement:
    """The result of refining on an object.

    rig_from_camera: of all pairs; those that did not measure the object, or would have moved farther
        than the calibration allows, keep their poses.
    """

    alignment: Alignment
    rig_from_camera: dict[str, RigidTransform]

    @property
    def better(self) -> bool:
        """Whether the RMS distance in the overlaps fell by more than 5 %.

        With less, poses would follow the warps of the pairs' own calibrations: two rigs became worse
        by a third and an eighth.
        """
        return self.alignment.rms_after_mm < 0.95 * self.alignment.rms_before_mm

    @property
    def lines(self) -> list[str]:
        """Figures before and after, and which pairs moved."""
        found = self.alignment
        lines = [
            f"{len(found.overlaps)} overlaps: {found.rms_before_mm:.3f} mm RMS before, "
            f"{found.rms_after_mm:.3f} after"
        ]
        if found.motion_mm:
            farthest = max(sorted(found.motion_mm), key=lambda name: found.motion_mm[name])
            lines.append(f"farthest moved: {farthest}, {found.motion_mm[farthest]:.3f} mm")
        lines += [
            f"{name} would move by {sigmas:.1f} sigmas of the calibration: its pose was kept"
            for name, sigmas in sorted(found.refused.items())
        ]
        return lines


def refine_on_object(
    images: Sequence[RangeImage],
    rig_from_camera: Mapping[str, RigidTransform],
    prior: PoseCovariance,
    poles: Mapping[str, str],
) -> ObjectRefinement:
    """Refine the poses of the pairs on an object.

    images: of one object that did not move while all pairs scanned it, background removed.
    poles: the pole of each pair that is mounted on one.

    Raises FailedWork if no two pairs measured the same part of it, or if it moved.
    """
    rigid = AlignmentSettings(sway_mm=0.0, sway_deg=0.0)
    found = align(images, rig_from_camera, prior, rigid)
    if not found.overlaps:
        raise FailedWork(
            "no two pairs see the same part of the object",
            remedy="take a larger object, or put it in view of more pairs",
        )
    _require_still(images, rig_from_camera, prior, poles, found.rms_after_mm)
    return ObjectRefinement(found, dict(rig_from_camera) | found.rig_from_camera)


def _require_still(
    images: Sequence[RangeImage],
    rig_from_camera: Mapping[str, RigidTransform],
    prior: PoseCovariance,
    poles: Mapping[str, str],
    rigid_rms_mm: float,
) -> None:
    """Raise FailedWork if motion brings overlaps closer than rigid poses do, with `rigid_rms_mm`.
    Overlaps of what moved come closer by rigid poses too, but by wrong ones."""
    settings = AlignmentSettings()
    aligned = align(images, rig_from_camera, prior, settings)
    person = align_person(images, rig_from_camera, aligned, prior, poles, settings)
    motion = person.motion
    if motion is None or person.alignment.rms_after_mm > 0.95 * rigid_rms_mm:
        return
    parts = PersonMotion.from_motion(motion).parts
    largest = max(parts, key=lambda part: part.moved_mm, default=None)
    by = f" by up to {largest.moved_mm:.1f} mm ({largest.name})" if largest else ""
    raise FailedWork(
        f"the object moved{by} during the scan: poses fitted to it would be wrong",
        remedy="scan a mannequin or another rigid object that stands still. If it did, a pair has "
        "moved since the calibration: run `check-calibration`",
    )
