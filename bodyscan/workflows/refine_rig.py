"""Refine a calibrated rig on a rigid object scanned by its pairs."""

from __future__ import annotations

from dataclasses import replace

from bodyscan.captures.folder import Captures
from bodyscan.errors import FailedWork
from bodyscan.fusion.cleaning import clean, require_subject
from bodyscan.motion.object_refinement import refine_on_object
from bodyscan.outcome import Outcome
from bodyscan.progress import Progress, silent, step
from bodyscan.registration.rig_calibration import RigCalibration
from bodyscan.workflows.range_images import reconstruct_range_images


def refine_rig(
    calibration: RigCalibration, captures: Captures, name: str, progress: Progress = silent
) -> Outcome[RigCalibration]:
    """Refine the poses of the pairs by ICP on a rigid object, within the covariance of the boards.

    captures: a scan of an object that stood still.
    name: what the calibration's notes call it.

    Raises FailedWork if the overlaps do not come closer or the object moved, ScanFailed if nothing
    was scanned.
    """
    measured = reconstruct_range_images(calibration, captures, progress)
    with step(progress, "aligning"):
        cleaned = clean(measured.value, calibration.rig_from_camera, calibration.rig.volume)
        found = refine_on_object(
            require_subject(cleaned),
            calibration.rig_from_camera,
            calibration.covariance,
            calibration.rig.poles,
        )
    if not found.better:
        what = "the overlaps do not come closer, or hardly: the calibration stays as it is"
        raise FailedWork("\n  ".join([what, *found.lines]))
    notes = (*calibration.notes, *(f"refined on {name}: {line}" for line in found.lines))
    refined = replace(calibration, rig_from_camera=found.rig_from_camera, notes=notes)
    return Outcome(refined, tuple(found.lines), measured.failures)
