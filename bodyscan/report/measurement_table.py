"""Measurements as tables, JSON and CSV, and landmarks as files."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.table import Table

from bodyscan.errors import BadInput
from bodyscan.files.atomic import format_json, write_json, write_text
from bodyscan.files.messages import require_suffix
from bodyscan.fusion.storage import StoredScan
from bodyscan.measurement.changes import MeasureChanges
from bodyscan.measurement.measurements import Measurements, measure
from bodyscan.measurement.named import MIN_MEASURED, NamedMeasures, read_definitions
from bodyscan.measurement.outline import Range
from bodyscan.mesh.body import DARK_CLOTH, HAIR, REGION_NAMES, SKIN
from bodyscan.version import __version__

MEASUREMENTS = "measurements.json"
COPIED = (
    *("stature_mm", "stature_measured", "crown", "regions", "volume_l", "area_m2", "measured"),
    *("at_mean_breath", "facing_known"),
)
"""Fields of `Measurements` that `measurements.json` has as they are."""


def tables(measured: Measurements, changes: MeasureChanges | None = None) -> Iterator[Table]:
    """The whole body, then one row for each part of each slice, from the top down."""
    body = Table("", "", title="body", show_header=False)
    body.columns[1].justify = "right"
    guess = "" if measured.stature_measured >= 0.5 else " (guessed: the crown was not measured)"
    of = {REGION_NAMES[HAIR]: " (top of the hair)", REGION_NAMES[DARK_CLOTH]: " (of a cap or hood)"}
    which = of.get(measured.crown or "", guess)
    body.add_row("stature in pose", f"{measured.stature_mm:.1f} mm{which}")
    if measured.head is not None and measured.crown != REGION_NAMES[SKIN]:
        head = measured.head
        body.add_row("of the head", f"{head.height_mm:.0f} ± {head.sigma_mm:.0f} mm (estimate)")
    body.add_row("volume", f"{measured.volume_l:.2f} l")
    body.add_row("area", f"{measured.area_m2:.3f} m2")
    body.add_row("of it measured", f"{100.0 * measured.measured:.1f} %")
    over = _name_covered(measured.regions)
    if over:
        body.add_row("of it covered", over)
    if not measured.facing_known:
        body.add_row("left and right", "assumed: no feet show which way the body faces")
    yield body
    breath = ", at mean breath" if measured.at_mean_breath else ""
    slices = Table(title=f"horizontal slices{breath}, mm")
    numbers = ("tape (hull)", "along surface", "width", "depth", "measured")
    for heading in ("height", "part", *numbers, "over"):
        slices.add_column(heading, justify="left" if heading in ("part", "over") else "right")
    for level in sorted(measured.slices, key=lambda level: -level.height_mm):
        for girth in level.girths:
            slices.add_row(
                f"{level.height_mm:.0f}",
                girth.part,
                _format_girth(girth.tape_mm, girth.tape_range_mm, girth.measured),
                _format_girth(girth.girth_mm, girth.girth_range_mm, girth.measured),
                f"{girth.width_mm:.1f}",
                f"{girth.depth_mm:.1f}",
                f"{100.0 * girth.measured:.0f} %",
                _name_covered(girth.regions),
                style="" if girth.measured_skin >= 0.95 else "yellow",
            )
    yield slices
    if measured.named is not None:
        yield _make_named_table(measured.named)
    if changes is not None:
        yield _changes_table(changes)


def _name_covered(regions: Mapping[str, float] | None) -> str:
    """Name what a girth crosses that is not skin, from 5 % on."""
    shares = {
        REGION_NAMES[k]: (regions or {}).get(REGION_NAMES[k], 0.0) for k in (HAIR, DARK_CLOTH)
    }
    return ", ".join(f"{name} {100.0 * s:.0f} %" for name, s in shares.items() if s > 0.05)


def _format_girth(value: float, between: Range, measured: float) -> str:
    """Give the range if more is open than a tape leaves, or more than a tenth was not measured. Two
    measurers with a tape differ by 4 mm (ISO 20685-1)."""
    low, high = between
    known = high - low <= 4.0 and measured >= MIN_MEASURED
    return f"{value:.1f}" if known else f"{low:.0f} to {high:.0f}"


def _make_named_table(named: NamedMeasures) -> Table:
    """Measures by name with their 95 % intervals, the interval alone where too little was measured."""
    table = Table(title="measures by name, mm")
    for heading in ("measure", "value", "95 %", "the standard's stance"):
        table.add_column(heading, justify="right" if heading in ("value", "95 %") else "left")
    for one in named.measures.values():
        low, high = one.interval_mm
        value = "" if one.is_range else f"{one.mm:.1f}"
        style = "yellow" if one.is_range else ""
        table.add_row(one.name, value, f"{low:.0f} to {high:.0f}", one.stance, style=style)
    for name, reason in named.missing.items():
        table.add_row(name, "", reason, "", style="yellow")
    return table


def _changes_table(changes: MeasureChanges) -> Table:
    """Changes since an earlier scan with their 95 % intervals, those that are certain marked."""
    scale = "" if changes.same_calibration else " (of other calibrations: their scales may differ)"
    table = Table(title=f"changes since {changes.when or 'the earlier scan'}, mm{scale}")
    for heading in ("measure", "change", "95 %", "changed"):
        table.add_column(heading, justify="right" if heading in ("change", "95 %") else "left")
    for one in changes.measures:
        low, high = one.interval_mm
        changed = one.reason or ("certainly" if one.is_certain else "")
        style = "bold" if one.is_certain else ""
        cells = f"{one.mm:+.1f}", f"{low:+.0f} to {high:+.0f}"
        table.add_row(one.name, *cells, changed, style=style)
    return table


MEASURE_COLUMNS = (
    *("subject", "when", "verdict", "name", "value", "low", "high", "unit", "measured"),
    *("standard", "clause", "stance", "definition", "reason"),
)
"""Of a table of measures by name: one row for each person and measure."""


def format_named_csv(
    named: NamedMeasures | str, facts: Mapping[str, Any], changes: MeasureChanges | None = None
) -> str:
    """Named measures as CSV: a row for each, lengths in mm; no value where it is a range, neither value
    nor interval where it could not be taken, for a reason.

    named: or the reason why there are none. facts: of the scan, as in its scan.json. changes: since an
        earlier scan, if one was given.
    """
    of_change = ("since", "change", "change_low", "change_high", "changed")
    by_name = {change.name: change for change in changes.measures} if changes else {}
    verdict = (facts.get("verdict") or {}).get("grade")
    scan = {"subject": facts.get("subject"), "when": facts.get("when"), "verdict": verdict}
    rows = []
    for definition in read_definitions():
        row = scan | {column: definition.get(column) for column in MEASURE_COLUMNS[9:13]}
        row |= {"name": definition["name"], "unit": "mm", "stance": None, "reason": named}
        if not isinstance(named, str):
            row["reason"] = named.missing.get(definition["name"])
            if measure := named.measures.get(definition["name"]):
                low, high = (round(end, 1) for end in measure.interval_mm)
                value = None if measure.is_range else round(measure.mm, 1)
                row |= {"value": value, "low": low, "high": high, "stance": measure.stance}
                row["measured"] = round(measure.measured, 3)
        if change := by_name.get(definition["name"]):
            ends = (round(value, 1) for value in (change.mm, *change.interval_mm))
            cells = (changes and changes.when, *ends, change.is_certain)
            row |= dict(zip(of_change, cells, strict=True))
        rows.append(row)
    return _write_csv(MEASURE_COLUMNS + (of_change if changes else ()), rows)


def format_landmarks_csv(named: NamedMeasures, facts: Mapping[str, Any]) -> str:
    """Landmarks as CSV: x, y, z in mm, rig frame; sigma by axis."""
    columns = ("subject", "when", "name", "x", "y", "z", "sigma", "unit", "found")
    scan = {"subject": facts.get("subject"), "when": facts.get("when"), "unit": "mm"}
    rows = []
    for landmark in named.landmarks.values():
        place = dict(zip("xyz", (round(value, 2) for value in landmark.position_mm), strict=True))
        row = {"name": landmark.name, "sigma": landmark.sigma_mm, "found": landmark.found}
        rows.append(scan | row | place)
    return _write_csv(columns, rows)


def format_landmarks_lnd(named: NamedMeasures, facts: Mapping[str, Any]) -> str:
    """Landmarks as CAESAR's .lnd files have them, in mm: number, three fields of its scanner's images
    (0 here), x, y, z, name."""
    lines = ["UNITS = mm", "AUX ="]
    for number, landmark in enumerate(named.landmarks.values(), start=1):
        x, y, z = landmark.position_mm
        lines.append(f"{number} 0 0 0 {x:.2f} {y:.2f} {z:.2f} {landmark.name.replace(' ', '_')}")
    return "\n".join([*lines, "END =", ""])


def format_landmarks_json(named: NamedMeasures, facts: Mapping[str, Any]) -> str:
    """Landmarks as JSON."""
    content = {"schema": "bodyscan-landmarks", "version": 1, "units": "mm", "frame": "rig"}
    scan = {"subject": facts.get("subject"), "when": facts.get("when")}
    landmarks = [asdict(landmark) for landmark in named.landmarks.values()]
    return format_json(content | scan | {"landmarks": landmarks})


LANDMARK_FORMATS = {
    ".csv": format_landmarks_csv,
    ".json": format_landmarks_json,
    ".lnd": format_landmarks_lnd,
}


def require_formats(
    path: Path, landmarks: Path | None, since: Path | None = None, *, named: bool
) -> None:
    """Raise BadInput if measurements or landmarks are not written to such files, or none are found."""
    require_suffix(path, (".json", ".csv"), "measurements")
    if since is not None and not named:
        raise BadInput("--since needs --named, whose measures it compares", remedy="give both")
    if landmarks is not None:
        require_suffix(landmarks, LANDMARK_FORMATS, "landmarks")
        if not named:
            raise BadInput("--landmarks needs --named, which finds them", remedy="give both")


def write_landmarks(path: Path, named: NamedMeasures, facts: Mapping[str, Any]) -> None:
    """Write landmarks as the path's suffix says, one of `LANDMARK_FORMATS`."""
    write_text(path, LANDMARK_FORMATS[path.suffix.lower()](named, facts))


def write_measurements(
    path: Path,
    measured: Measurements,
    facts: Mapping[str, Any],
    changes: MeasureChanges | None = None,
) -> None:
    """Write measurements as JSON, or as CSV if the path's suffix says so, with changes if any."""
    if path.suffix.lower() == ".csv":
        write_text(path, format_measurements_csv(measured, facts, changes))
    else:
        write_json(path, make_measurements_document(measured, facts, changes))


def write_measures(stored: StoredScan, folder: Path) -> str:
    """Write measurements.json and measures.csv of a scan, and its landmarks in every format; returns
    why there are none by name, or "". A scan that no standing body fits has all else."""
    reason = ""
    try:
        measured = measure(stored.mesh, named=True)
    except BadInput as error:
        reason, measured = error.what, measure(stored.mesh, anyway=True)
    named = measured.named
    write_measurements(folder / MEASUREMENTS, measured, stored.facts)
    write_text(folder / "measures.csv", format_named_csv(named or reason, stored.facts))
    if named is not None:
        for suffix in LANDMARK_FORMATS:
            write_landmarks(folder / f"landmarks{suffix}", named, stored.facts)
    return reason


def _write_csv(columns: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> str:
    text = io.StringIO()
    table = csv.DictWriter(text, columns, extrasaction="ignore")
    table.writeheader()
    table.writerows(rows)
    return text.getvalue()


def make_measurements_document(
    measured: Measurements, facts: Mapping[str, Any], changes: MeasureChanges | None = None
) -> dict[str, Any]:
    """Content of `measurements.json`; facts: of the scan, as in its scan.json; changes, as in
    `format_named_csv`."""
    named = measured.named
    by_name = named and {
        "landmarks": [asdict(landmark) for landmark in named.landmarks.values()],
        "measures": [asdict(m) | {"path_mm": m.path_mm.round(1)} for m in named.measures.values()],
        "not_measured": dict(named.missing),
        "posture": asdict(named.posture),
    }
    return {
        "schema": "bodyscan-measurements",
        "version": 1,
        "software": f"bodyscan {__version__}",
        "units": {"lengths": "mm", "volume_l": "l", "area_m2": "m2", "area_mm2": "mm2"},
        "subject": facts.get("subject"),
        "when": facts.get("when"),
        "calibration_id": facts.get("calibration_id"),
        "verdict": facts.get("verdict"),
        "head_mm": measured.head and measured.head.height_mm,
        "head_sigma_mm": measured.head and measured.head.sigma_mm,
        **{name: getattr(measured, name) for name in COPIED},
        "rig_from_body": measured.rig_from_body.matrix,
        "slices": [asdict(level) for level in measured.slices],
        **(by_name or {}),
        **(_describe_changes(changes) if changes else {}),
    }


def _describe_changes(changes: MeasureChanges) -> dict[str, Any]:
    earlier = {"when": changes.when, "same_calibration": changes.same_calibration}
    described = [asdict(one) | {"is_certain": one.is_certain} for one in changes.measures]
    return {"compared_with": changes.subject, "since": earlier, "changes": described}


def format_measurements_csv(
    measured: Measurements, facts: Mapping[str, Any], changes: MeasureChanges | None = None
) -> str:
    """Measurements as CSV: `Measurements.to_records`, each with the scan's subject, date and grade; or
    those by name, if they were asked for."""
    if measured.named is not None:
        return format_named_csv(measured.named, facts, changes)
    scan = {"subject": facts.get("subject"), "when": facts.get("when")}
    scan["grade"] = (facts.get("verdict") or {}).get("grade")
    records = [scan | record for record in measured.to_records()]
    return _write_csv(tuple(records[0] if records else scan), records)
