"""The scans of a day as rows of a table: what the watch told, what lies in the output folder, and what
people decided.

Nothing is kept here that is not on the disk, except how far the scan is that runs now.
"""

from __future__ import annotations

import csv
import io
import json
import re
import threading
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from bodyscan.errors import BadInput
from bodyscan.files.atomic import write_json
from bodyscan.jobs.job import JOB, MEASURES, STATE, read_record
from bodyscan.verdict import MARKS

DECISIONS = ("keep", "repeat", "discard")
DECIDED = "station.json"
"""What people decided of a scan, in its job's folder: forgotten with it."""

Row = dict[str, Any]

GIRTHS = {"chest_mm": "bust girth", "waist_mm": "waist girth", "hip_mm": "hip girth"}
"""Cells of a row, and the measures that they hold."""

COLUMNS = (
    *("job", "subject", "when", "state", "grade", "reasons", "decision", "note"),
    *("sway_mm", "breath_mm", "coverage_percent", "stature_mm", *GIRTHS),
    *("points", "seconds", "reason"),
)


class Day:
    """Rows by job, the newest last."""

    def __init__(self, out: Path) -> None:
        self.out = out
        self._rows: dict[str, Row] = {}
        self._cloud: tuple[str, Any] = ("", None)
        self._lock = threading.Lock()
        for folder in sorted(out.glob(f"*/{JOB}"), key=lambda path: path.stat().st_mtime_ns):
            self._rows[folder.parent.name] = read_row(folder.parent)

    def rows(self) -> list[Row]:
        """All rows, to be read only; those whose files were removed, as `forget` does, are gone."""
        with self._lock:
            # Of a job that was refused there never was a folder: it has no subject.
            for job in [job for job, row in self._rows.items() if row["subject"] is not None]:
                if not (self.out / job / JOB).exists():
                    del self._rows[job]
            return list(self._rows.values())

    def row(self, job: str) -> Row:
        """The row of a job. Raises KeyError if there is none: no name leads anywhere else."""
        return self._rows[job]

    def take(self, event: Mapping[str, Any]) -> Row | None:
        """Take an event of the watch; return the row that it changed."""
        job = event.get("job", "")
        if event["event"] not in ("images", "job", "verdict", "stage", "cloud"):
            return None
        with self._lock:
            row = self._rows.pop(job, None) or make_empty_row(job)
            self._rows[job] = row = {**row, **self._changes(job, row, event)}
            return row

    def _changes(self, job: str, row: Row, event: Mapping[str, Any]) -> Row:
        what = event["event"]
        if what == "images":
            begins = row["state"] in ("done", "set aside")  # taken again
            started = {**make_empty_row(job), "note": row["note"]} if begins else {}
            return {**started, "scan": event["scan"], "pairs": event["pairs"]}
        if what == "verdict":
            return make_verdict_cells(event["grade"], event["reasons"]) | {"final": event["final"]}
        if what == "stage":
            keys = ("part", "done", "total")
            return {"part": event["stage"]} | {key: event[key] for key in keys if key in event}
        if what == "cloud":
            self._cloud = (job, event["cloud"])
            return {"body": "cloud"}
        if event["state"] == "running":
            subject = read_record(self.out / job / JOB).get("subject")
            return {"state": "running", "part": "", "subject": subject}
        known = {key: event[key] for key in ("state", "seconds", "reason") if key in event}
        return {**read_row(self.out / job), **known, "scan": row["scan"], "pairs": row["pairs"]}

    def decide(self, job: str, changes: Mapping[str, Any]) -> Row:
        """Record a person's `decision` and `note`. Raises BadInput for others, or before fusion."""
        decision, note = changes.get("decision"), changes.get("note")
        known = decision is None or decision in DECISIONS
        noted = note is None or (isinstance(note, str) and len(note) <= 2000)
        if not (known and noted and changes.keys() <= {"decision", "note"}):
            raise BadInput(f"a scan is to {', '.join(DECISIONS)}, with a note of 2,000 characters")
        if job not in self._rows or not (self.out / job / JOB).is_file():
            raise BadInput("there is no such scan yet")
        with self._lock:
            path = self.out / job / DECIDED
            write_json(path, {**read_record(path), **changes})
            self._rows[job] = row = {**self._rows[job], **changes}
            return row

    def body(self, job: str) -> Any:
        """The packed model of a scan: the report's, or the coarse cloud before; else None."""
        report = self.out / job / "report" / "report.html"
        if report.is_file():
            found = re.search(
                r'<script type="application/json">(.*?)</script>', report.read_text("utf-8")
            )
            return json.loads(found[1]) if found else None
        return self._cloud[1] if self._cloud[0] == job else None


def make_empty_row(job: str) -> Row:
    """The row of a scan of which nothing is known."""
    row: Row = dict.fromkeys(COLUMNS)
    row |= {"job": job, "state": "arriving", "note": "", "pairs": {}, "scan": "", "mark": None}
    return row | {"final": False, "body": None, "part": "", "done": 0, "total": 0}


def make_verdict_cells(grade: str, reasons: Iterable[str]) -> Row:
    """The cells that a verdict fills."""
    return {"grade": grade, "mark": MARKS.get(grade, "bad"), "reasons": list(reasons)}


def read_row(folder: Path) -> Row:
    """The row of a job, from its folder."""
    row = make_empty_row(folder.name)
    state, job = read_record(folder / STATE), read_record(folder / JOB)
    facts, decided = read_record(folder / "scan" / "scan.json"), read_record(folder / DECIDED)
    row["subject"], row["scan"] = job.get("subject"), Path(str(job.get("source") or "")).name
    ended = state.get("state") in ("done", "set aside")
    row |= {key: state[key] for key in ("seconds", "reason", "when") if key in state}
    row["state"] = state["state"] if ended else "arriving"  # what was interrupted begins anew
    row |= {key: decided[key] for key in ("decision", "note") if key in decided}
    if not facts or not ended:
        return row
    verdict, counts = facts.get("verdict") or {}, facts.get("counts") or {}
    motion = (facts.get("alignment") or {}).get("motion_mm") or {}
    row |= make_verdict_cells(verdict.get("grade", "usable"), verdict.get("reasons", ()))
    row["final"] = True
    row["body"] = "mesh" if (folder / "report" / "report.html").is_file() else None
    row["when"] = facts.get("when") or row["when"]
    row["sway_mm"] = max(motion.values(), default=None)
    row["breath_mm"] = (facts.get("person") or {}).get("breathed_mm")
    row["stature_mm"], row["points"] = facts.get("stature_mm"), counts.get("points")
    if "filled_share" in counts:
        row["coverage_percent"] = 100.0 * (1.0 - counts["filled_share"])
    return row | read_girths(folder / "measures" / MEASURES)


def read_girths(path: Path) -> Row:
    """The cells of GIRTHS from a table of measures: mm, or "low-high" where only that is known."""
    try:
        table = {one["name"]: one for one in csv.DictReader(io.StringIO(path.read_text("utf-8")))}
        return {
            cell: float(one["value"])
            if one["value"]
            else f"{float(one['low']):.0f}-{float(one['high']):.0f}"
            for cell, name in GIRTHS.items()
            if (one := table.get(name)) and (one["value"] or one["low"])
        }
    except (OSError, ValueError, KeyError):
        return {}  # no measures, or a damaged table


def format_table_csv(rows: Iterable[Row]) -> str:
    """The rows as CSV; a cell that a spreadsheet would take for a formula begins with an apostrophe."""

    def cell(value: Any) -> Any:
        text = "; ".join(value) if isinstance(value, list) else value
        risky = isinstance(text, str) and text[:1] in ("=", "+", "-", "@")
        return f"'{text}" if risky else text

    text = io.StringIO()
    table = csv.writer(text)
    table.writerow(COLUMNS)
    table.writerows([cell(row[column]) for column in COLUMNS] for row in rows)
    return text.getvalue()
