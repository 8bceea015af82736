"""The report of an acceptance test, on screen and as a page."""

from __future__ import annotations

from collections.abc import Sequence

from rich.table import Table as ScreenTable

from bodyscan.evaluation.acceptance import ALL, Figure, Readings, grade_acceptance
from bodyscan.registration.rig_calibration import RigCalibration
from bodyscan.report.page import Column, Lines, Numbers, Page, Section, Table, format_value

NO_STANDARD = (
    "Modelled on VDI/VDE 2634 parts 2 and 3 and ISO 20685-2; it is no test by these standards, "
    "which ask for more artefacts and places, and for calibrated ones."
)


def make_screen_table(found: Sequence[Figure], synthetic: bool) -> ScreenTable:
    table = ScreenTable(title=f"acceptance{' (synthetic)' if synthetic else ''}")
    for heading in ("figure", "mm", "limit", "where"):
        table.add_column(heading, justify="right" if heading in ("mm", "limit") else "left")
    for one in found:
        table.add_row(
            one.title,
            format_value(one.value_mm),
            "–" if one.limit_mm is None else f"{one.limit_mm:g}",
            one.where,
            style="red" if one.exceeded else None,
        )
    return table


def make_acceptance_page(
    found: Sequence[Figure],
    readings: Readings,
    calibration: RigCalibration,
    calibration_id: str,
    synthetic: bool,
) -> Page:
    numbers = Numbers(
        tuple(
            (
                Column(one.title, "mm", f"{one.meaning}; the largest: {one.where}", one.limit_mm),
                None if one.value_mm is None else abs(one.value_mm),
            )
            for one in found
        )
    )
    spheres = Table(
        (
            *(Column(name) for name in ("place, shot, sphere", "by", "points")),
            Column("form", "mm", "probing form."),
            Column("shell", "mm", "width of the shell that holds 90 % of the points."),
            Column("size", "mm", "probing size."),
        ),
        tuple(
            (f"{r.place}, {r.shot}, {r.sphere}", r.view, r.points, r.form_mm, r.shell_mm, r.size_mm)
            for r in readings.spheres
            if r.view == ALL
        ),
    )
    spacings = Table(
        (Column("place, shot"), Column("spheres"), Column("spacing error", "mm")),
        tuple((f"{r.place}, {r.shot}", r.between, r.error_mm) for r in readings.spacings),
    )
    plates = Table(
        (
            *(Column(name) for name in ("place, shot", "by", "points")),
            Column("flatness", "mm", "range of the distances from the best plane."),
            Column("RMS", "mm", "of the distances from the best plane."),
            Column("measured", "%", "of the plate's area.", digits=0),
        ),
        tuple(
            (f"{r.place}, {r.shot}", r.view, r.points, r.flatness_mm, r.rms_mm, r.measured_percent)
            for r in readings.plates
        ),
    )
    return Page(
        f"Acceptance of rig {calibration.rig.name}",
        grade_acceptance(found, readings),
        synthetic,
        (("calibration", calibration_id[:12]),),
        calibration.axes,
        [
            Section("Figures", [NO_STANDARD, numbers]),
            Section("Spheres, all pairs merged", [spheres, spacings]),
            Section("Plate", [plates]),
            Section("Problems", [Lines(readings.problems or ("None.",))]),
        ],
    )
