"""Report a stored calibration or scan as one HTML file."""

from __future__ import annotations

from pathlib import Path

from bodyscan.errors import BadInput
from bodyscan.files.atomic import write_json, write_text
from bodyscan.registration.storage import REPORT_NAME
from bodyscan.report.page import render
from bodyscan.report.result_page import build_page
from bodyscan.verdict import Verdict


def write_report(
    result: Path, path: Path | None = None, other: Path | None = None
) -> tuple[Path, Verdict]:
    """Write the report; return its path and its verdict.

    result: what calibrate-rig or scan wrote.
    path: report.html in the result if None.
    other: a scan or a known surface to compare with.

    Raises BadInput for anything that is not a result.
    """
    folder = result if result.is_dir() else result.parent
    path = path or folder / REPORT_NAME
    if path.is_dir():
        raise BadInput("is a folder", where=str(path), remedy="give --out the name of a file")
    page = build_page(result, other)
    write_text(path, render(page))
    if page.subject is not None and path.parent.resolve() != folder.resolve():
        # As beside an export, so that `bodyscan forget` knows whose it is.
        write_json(path.with_name(f"{path.name}.json"), {"subject": page.subject})
    return path, page.verdict
