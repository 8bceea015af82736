"""An acceptance test: read artefacts at several places, judge the readings, write the report."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from bodyscan.captures.folder import open_scan
from bodyscan.errors import BadInput
from bodyscan.evaluation.acceptance_file import AcceptanceFile
from bodyscan.evaluation.acceptance_readings import (
    Figure,
    Readings,
    acceptance_document,
    figures,
    grade_acceptance,
)
from bodyscan.files.atomic import write_json, write_text
from bodyscan.files.os_errors import require_writable
from bodyscan.optional import optional
from bodyscan.progress import Progress, silent
from bodyscan.registration.rig_calibration import RigCalibration
from bodyscan.registration.storage import calibration_id
from bodyscan.report.acceptance_page import acceptance_page
from bodyscan.report.page import render
from bodyscan.verdict import Verdict
from bodyscan.workflows.read_artefacts import read_plates, read_spheres

FILE_NAME = "acceptance.json"


@dataclass(frozen=True)
class Acceptance:
    """The result of an acceptance test.

    figures: the worst over all places, with their limits.
    file: path of acceptance.json.
    page: path of the report, None if it could not be made, as `notes` say.
    """

    figures: tuple[Figure, ...]
    verdict: Verdict
    file: Path
    page: Path | None
    notes: tuple[str, ...]


def refuse_former(folder: Path, overwrite: bool) -> None:
    """Raise BadInput if `folder` holds a test that may not be replaced, or cannot be written to."""
    require_writable(folder)
    if (folder / FILE_NAME).exists() and not overwrite:
        raise BadInput(
            "an acceptance test lies here already",
            where=str(folder),
            remedy="give another --out, or say --overwrite",
        )


def read_captures(
    calibration: RigCalibration,
    spheres: Sequence[Path],
    plates: Sequence[Path],
    file: AcceptanceFile,
    progress: Progress = silent,
) -> Readings:
    """Read captured artefacts, one folder a place."""
    # Open them all before reading the first, so that a wrong folder fails before any work is done.
    places = [
        (folder, open_scan(calibration.rig, folder), read)
        for folders, read in ((spheres, read_spheres), (plates, read_plates))
        for folder in folders
    ]
    total = Readings()
    for folder, captures, read in places:
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
    """Write figures and verdict to acceptance.json and acceptance.html in `out`, and return them.

    stored: path of the calibration.
    synthetic: whether the artefacts were simulated.
    """
    found = figures(readings, file)
    origin = calibration_id(stored)
    content = acceptance_document(readings, found, file, synthetic=synthetic, calibration_id=origin)
    file_path, page_path = out / FILE_NAME, out / "acceptance.html"
    write_json(file_path, content)
    notes: list[str] = []
    page_path.unlink(missing_ok=True)  # left by an earlier test
    with optional("report", notes.append):
        page = acceptance_page(found, readings, calibration, origin, synthetic)
        write_text(page_path, render(page))
    return Acceptance(
        tuple(found),
        grade_acceptance(found, readings),
        file_path,
        page_path if page_path.exists() else None,
        tuple(notes),
    )
