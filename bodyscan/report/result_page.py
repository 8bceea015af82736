"""Finds out what a folder holds, a calibration or a scan, and makes its report."""

from __future__ import annotations

from pathlib import Path

from bodyscan.errors import BadInput
from bodyscan.fusion import scan_facts as scans
from bodyscan.registration import storage as calibrations
from bodyscan.report.page import Page

REMEDY = "give the folder that `bodyscan calibrate-rig` or `bodyscan scan` wrote"


def build_page(result: Path, other: Path | None = None) -> Page:
    """The page for a calibration or scan, given as its folder or as the JSON in it.

    Raises BadInput if it is neither, or if `other` is given for a calibration.
    """
    if not result.exists():
        raise BadInput("there is no such file or folder", where=str(result), remedy=REMEDY)
    folder = result if result.is_dir() else result.parent
    names = {result.name} if result.is_file() else {path.name for path in folder.glob("*.json")}
    if scans.FILE_NAME in names:
        from bodyscan.report.scan_page import scan_page

        return scan_page(folder, other)
    if calibrations.FILE_NAME not in names:
        raise BadInput(
            f"holds neither {calibrations.FILE_NAME} nor {scans.FILE_NAME}",
            where=str(result),
            remedy=REMEDY,
        )
    if other is not None:
        raise BadInput(
            "is a calibration: only scans can be compared",
            where=str(result),
            remedy="give a scan's folder; what moved in a rig, `bodyscan check-calibration` tells",
        )
    from bodyscan.report.calibration_page import calibration_page

    return calibration_page(folder)
