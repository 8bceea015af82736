"""A calibrated rig as files for other programs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from bodyscan.interchange.rig_format import RIG_FORMATS, RigCameras
from bodyscan.registration.rig_calibration import RigCalibration


def export_rig(calibration: RigCalibration, folder: Path, formats: Sequence[str]) -> list[Path]:
    """Write the rig in each format; returns what was written.

    Raises BadInput for a format that there is not, before anything is written, and for a lens that
    a format cannot express.
    """
    chosen = [RIG_FORMATS.find(name.strip().lower()) for name in dict.fromkeys(formats)]
    cameras = cameras_of(calibration)
    return [format_.write(cameras, folder / format_.path) for format_ in chosen]


def cameras_of(calibration: RigCalibration) -> RigCameras:
    """Camera and pose of every pair of a calibration."""
    return {
        name: (pair.camera, calibration.rig_from_camera[name])
        for name, pair in calibration.pairs.items()
    }
