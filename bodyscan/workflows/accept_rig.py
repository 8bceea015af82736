"""An acceptance test: artefacts read at several places, judged, reported."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from bodyscan.captures.folder import open_scan
from bodyscan.evaluation.acceptance_file import AcceptanceFile
from bodyscan.evaluation.acceptance_readings import (
    Figure,
    Readings,
    acceptance_document,
    figures,
    grade_acceptance,
)
from bodyscan.files.atomic import write_json, write_text
from bodyscan.progress import Progress, silent
from bodyscan.registration.rig_calibration import RigCalibration
from bodyscan.registration.storage import calibration_id
from bodyscan.report.acceptance_page import acceptance_page
from bodyscan.report.page import render
from bodyscan.verdict import Verdict
from bodyscan.workflows.accept import read_plates, read_spheres


@dataclass(frozen=True)
class Acceptance:
    """figures: the worst of all places, with their limits.  page: the report, where it lies."""

    figures: tuple[Figure, ...]
    verdict: Verdict
    page: Path


def read_captures(
    calibration: RigCalibration,
    spheres: Sequence[Path],
    plates: Sequence[Path],
    file: AcceptanceFile,
    progress: Progress = silent,
) -> Readings:
    """Readings of captured artefacts, a folder a place."""
    total = Readings()
    for folders, read in ((spheres, read_spheres), (plates, read_plates)):
        for folder in folders:
            captures = open_scan(calibration.rig, folder)
            total += read(calibration, captures, folder.name, file, progress)
    return total


def judge_readings(
    readings: Readings,
    file: AcceptanceFile,
    calibration: RigCalibration,
    stored: Path,
    out: Path,
    *,
    synthetic: bool,
) -> Acceptance:
    """Figures and verdict, written to acceptance.json and acceptance.html in `out`.

    stored: where the calibration lies.  synthetic: the artefacts were simulated.
    """
    found = figures(readings, file)
    origin = calibration_id(stored)
    content = acceptance_document(readings, found, file, synthetic=synthetic, calibration_id=origin)
    write_json(out / "acceptance.json", content)
    page = acceptance_page(found, readings, calibration.rig.name, origin, synthetic)
    write_text(out / "acceptance.html", render(page))
    return Acceptance(tuple(found), grade_acceptance(found, readings), out / "acceptance.html")
