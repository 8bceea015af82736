"""A calibrated rig as files for other programs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from bodyscan.export.rig_format import RIG_FORMATS
from bodyscan.registration.rig_calibration import RigCalibration


def export_rig(calibration: RigCalibration, folder: Path, formats: Sequence[str]) -> list[Path]:
    """Write the rig in each format; returns what was written.

    Raises BadInput for a format that there is not, before anything is written.
    """
    chosen = [RIG_FORMATS.find(name.strip().lower()) for name in dict.fromkeys(formats)]
    return [format_.write(calibration, folder / format_.path) for format_ in chosen]
