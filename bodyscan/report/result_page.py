"""Report a stored calibration or scan as one HTML file."""

from __future__ import annotations

from pathlib import Path

from bodyscan.errors import BadInput
from bodyscan.files.atomic import write_json, write_text
from bodyscan.files.messages import require_suffix
from bodyscan.fusion import storage as scans
from bodyscan.registration import storage as calibrations
from bodyscan.report.page import Page, render

REMEDY = "give the folder that `bodyscan calibrate-rig` or `bodyscan scan` wrote"


def write_report(
    result: Path, path: Path | None = None, other: Path | None = None
) -> tuple[Path, Page]:
    """Write the report; return its path and what it shows.

    result: what calibrate-rig or scan wrote.
    path: report.html in the result if None.
    other: a scan or a known surface to compare with.

    Raises BadInput for anything that is not a result.
    """
    folder = result if result.is_dir() else result.parent
    path = path or folder / calibrations.REPORT_NAME
    if path.is_dir():
        raise BadInput("is a folder", where=str(path), remedy="give --out the name of a file")
    require_suffix(path, (".html", ".htm"), "a report")
    page = build_page(result, other)
    write_text(path, render(page))
    # As beside an export, so that `bodyscan forget` knows whom it shows.
    shown = {"subject": page.subject, "compared_with": _find_subject(other)}
    is_inside = path.parent.resolve() == folder.resolve()
    description = path.with_name(f"{path.name}.json")
    if shown["compared_with"] or (page.subject and not is_inside):
        write_json(description, {key: value for key, value in shown.items() if value})
    else:
        description.unlink(missing_ok=True)  # of an earlier comparison
    return path, page


def _find_subject(scan: Path | None) -> str | None:
    """The pseudonym that a scan's folder, or its file in it, names; None for a surface without."""
    folder = scan if scan is None or scan.is_dir() else scan.parent
    if folder is None or not (folder / scans.FILE_NAME).is_file():
        return None
    subject = scans.read_facts(folder).get("subject")
    return subject if isinstance(subject, str) else None


def build_page(result: Path, other: Path | None = None) -> Page:
    """Build the page for a calibration or scan, given as its folder or as the JSON in it.

    Raises BadInput if it is neither, or if `other` is given for a calibration.
    """
    if not result.exists():
        raise BadInput("there is no such file or folder", where=str(result), remedy=REMEDY)
    folder = result if result.is_dir() else result.parent
    names = {result.name} if result.is_file() else {path.name for path in folder.glob("*.json")}
    # A batch's job is taken for its scan too, so that the error says where that is.
    if scans.FILE_NAME in names or (folder / "scan" / scans.FILE_NAME).is_file():
        from bodyscan.report.scan_page import make_scan_page

        return make_scan_page(folder, other)
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
            remedy="give a scan's folder; `bodyscan check-calibration` finds what moved in a rig",
        )
    from bodyscan.report.calibration_page import make_calibration_page

    return make_calibration_page(folder)
