"""Measurements as a table and as a JSON document."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from typing import Any

from rich.table import Table

from bodyscan.measurement.measurements import Measurements
from bodyscan.measurement.named import NamedMeasures
from bodyscan.measurement.outline import Range
from bodyscan.mesh.body import DARK_CLOTH, HAIR, REGION_NAMES, SKIN
from bodyscan.version import __version__

COPIED = (
    *("stature_mm", "stature_measured", "crown", "regions", "volume_l", "area_m2", "measured"),
    *("at_mean_breath", "facing_known"),
)
"""Fields of `Measurements` that `measurements.json` has as they are."""


def tables(measured: Measurements) -> Iterator[Table]:
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
        yield _named_table(measured.named)


def _name_covered(regions: Mapping[str, float] | None) -> str:
    """Name what a girth crosses that is not skin, from 5 % on."""
    shares = {
        REGION_NAMES[k]: (regions or {}).get(REGION_NAMES[k], 0.0) for k in (HAIR, DARK_CLOTH)
    }
    return ", ".join(f"{name} {100.0 * s:.0f} %" for name, s in shares.items() if s > 0.05)


def _format_girth(value: float, between: Range, measured: float) -> str:
    """Give the range if more is open than a tape leaves, or more than a tenth was not measured.

    Two measurers with a tape differ by 4 mm (ISO 20685-1).
    """
    low, high = between
    known = high - low <= 4.0 and measured >= 0.9
    return f"{value:.1f}" if known else f"{low:.0f} to {high:.0f}"


def _named_table(named: NamedMeasures) -> Table:
    """Measures by name with their 95 % intervals, the interval alone where too little was measured."""
    table = Table(title="measures by name, mm")
    for heading, side in (("measure", "left"), ("value", "right"), ("95 %", "right")):
        table.add_column(heading, justify="left" if side == "left" else "right")
    for measure in named.measures.values():
        low, high = measure.interval_mm
        value = "" if measure.is_range else f"{measure.mm:.1f}"
        style = "yellow" if measure.is_range else ""
        table.add_row(measure.name, value, f"{low:.0f} to {high:.0f}", style=style)
    for name, reason in named.missing.items():
        table.add_row(name, "", reason, style="yellow")
    return table


def named_csv(named: NamedMeasures, facts: Mapping[str, Any]) -> str:
    """Named measures as CSV: a row for each, lengths in mm; facts: of the scan, as in its scan.json."""
    text = io.StringIO()
    names = ("subject", "when", "name", "value", "low", "high", "unit", "measured", "standard")
    table = csv.DictWriter(text, (*names, "definition"), extrasaction="ignore")
    table.writeheader()
    scan = {"subject": facts.get("subject"), "when": facts.get("when"), "unit": "mm"}
    for measure in named.measures.values():
        low, high = measure.interval_mm
        value = None if measure.is_range else measure.mm
        table.writerow(scan | asdict(measure) | {"value": value, "low": low, "high": high})
    return text.getvalue()


def measurements_document(measured: Measurements, facts: Mapping[str, Any]) -> dict[str, Any]:
    """Content of `measurements.json`; facts: of the scan, as in its scan.json."""
    named = measured.named
    by_name = named and {
        "landmarks": [asdict(landmark) for landmark in named.landmarks.values()],
        "measures": [asdict(measure) for measure in named.measures.values()],
        "not_measured": dict(named.missing),
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
    }


def measurements_csv(content: Mapping[str, Any]) -> str:
    """The `measurements_document` as CSV: a row for each part of each slice, beside what is of the
    whole body; lengths in mm, ranges as `low` and `high`."""
    keys = ("subject", "when", "stature_mm", "volume_l", "area_m2", "at_mean_breath")
    body = {key: content[key] for key in keys}
    body |= {"grade": (content["verdict"] or {}).get("grade")}
    ends = ("girth_low_mm", "girth_high_mm", "tape_low_mm", "tape_high_mm")
    part = ("part", "girth_mm", "tape_mm", "width_mm", "depth_mm", "area_mm2", "measured")
    text = io.StringIO()
    table = csv.DictWriter(text, (*body, "height_mm", *part, *ends), extrasaction="ignore")
    table.writeheader()
    for level in content["slices"]:
        for girth in level["girths"]:
            between = (*girth["girth_range_mm"], *girth["tape_range_mm"])
            row = body | girth | {"height_mm": level["height_mm"]}
            table.writerow(row | dict(zip(ends, between, strict=True)))
    return text.getvalue()
