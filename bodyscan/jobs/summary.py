"""The table over all jobs of a batch, and the drift of the rig over the day."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from bodyscan.alignment.displaced_poles import PairDrift, estimate_drift
from bodyscan.arrays import Array
from bodyscan.files.atomic import write_json, write_text
from bodyscan.files.hashing import hash_file
from bodyscan.jobs.job import MANIFEST, MEASURES, SUMMARY, Job, read_record
from bodyscan.jobs.supervision import JobResult
from bodyscan.settings import BODY_CENTRE_MM

COLUMNS = {
    "fuse": (
        "verdict",
        "verdict_reasons",
        "points",
        "faces",
        "coverage_percent",
        "sigma_mm",
        "pairs_measured",
        "pairs_failed",
        "overlap_rms_before_mm",
        "overlap_rms_after_mm",
        "sway_mm",
        "sway_pair",
    ),
    "calibrate": ("pairs", "pairs_failed", "corners_rms_px", "sheets_rms_mm"),
}


def write_summary(jobs: Sequence[Job], outcomes: Sequence[JobResult], out: Path) -> Path:
    """Write summary.csv (one row per job, columns as in docs/formats.md); returns its path."""
    kind = jobs[0].pipeline.kind
    rows = [_make_row(job, outcome) for job, outcome in zip(jobs, outcomes, strict=True)]
    first = ("job", "subject", "when", "state", "attempts", "seconds", "stages")
    text = io.StringIO()
    table = csv.DictWriter(text, (*first, *COLUMNS[kind], "reason"), extrasaction="ignore")
    table.writeheader()
    table.writerows(rows)
    _write_table(out / SUMMARY, text)
    return out / SUMMARY


def _write_table(path: Path, text: io.StringIO) -> None:
    write_text(path, text.getvalue().encode("utf-8", "backslashreplace").decode())


def write_day_measures(jobs: Sequence[Job], out: Path) -> Path | None:
    """Write measures.csv: the rows of every job's, after the job's name; None if no job has any."""
    text, table = io.StringIO(), None
    for job in jobs:
        try:
            rows = csv.DictReader(
                io.StringIO((job.folder / "measures" / MEASURES).read_text("utf-8"))
            )
        except OSError:
            continue
        if table is None:
            table = csv.DictWriter(text, ("job", *(rows.fieldnames or ())), extrasaction="ignore")
            table.writeheader()
        table.writerows({"job": job.name} | row | {"subject": job.subject} for row in rows)
    if table is None:
        return None
    _write_table(out / MEASURES, text)
    return out / MEASURES


def write_out_manifest(out: Path) -> None:
    """Write the manifests of all jobs under one hash each, so that a vanished job is missed."""
    found = sorted(path for path in out.glob(f"*/{MANIFEST}") if not path.parent.is_symlink())
    jobs = {path.parent.name: hash_file(path) for path in found}
    write_json(out / MANIFEST, {"schema": "bodyscan-batch", "version": 1, "jobs": jobs})


def list_scans_to_repeat(jobs: Sequence[Job]) -> list[str]:
    """List the jobs whose scan was fused but has the verdict `repeat`, by name."""
    verdicts = {job.name: _read_facts(job).get("verdict") for job in jobs}
    return [name for name, verdict in verdicts.items() if verdict and verdict["grade"] == "repeat"]


def find_drift(jobs: Sequence[Job]) -> list[PairDrift]:
    """Find pairs that alignment moves the same way in all scans of a calibration, farthest first;
    sway differs from scan to scan."""
    shifts: dict[tuple[Path | None, str], list[Array]] = {}
    for job in jobs:
        for pair, shift in pair_motions(job).items():
            shifts.setdefault((job.calibration, pair), []).append(shift)
    found = [estimate_drift(pair, np.array(each)) for (_, pair), each in shifts.items()]
    return sorted((one for one in found if one.moved), key=lambda one: -one.shift_mm)


def _make_row(job: Job, outcome: JobResult) -> dict[str, Any]:
    row = asdict(outcome) | {
        "subject": job.subject,
        "stages": " ".join(outcome.stages),
        "reason": " ".join(outcome.reason.split()),
    }
    if outcome.state != "done":
        return row
    if job.pipeline.kind == "calibrate":
        return row | _collect_rig_figures(
            read_record(job.folder / "calibration" / "calibration.json")
        )
    return row | _collect_scan_figures(_read_facts(job))


def _collect_scan_figures(facts: Mapping[str, Any]) -> dict[str, Any]:
    if not facts:
        return {}
    counts, alignment = facts["counts"], facts["alignment"]
    verdict = facts.get("verdict") or {}
    figures = {
        "verdict": verdict.get("grade"),
        "verdict_reasons": "; ".join(r.partition("\n")[0] for r in verdict.get("reasons", ())),
        "when": facts["when"],
        "points": counts["points"],
        "faces": counts["faces"],
        "coverage_percent": _round(100.0 * (1.0 - counts["filled_share"]), 2),
        "sigma_mm": _round(facts["median_sigma_mm"]),
        "pairs_measured": sum(points > 0 for points in facts["measured"].values()),
        "pairs_failed": " ".join(sorted(facts["failed"])),
    }
    if alignment and alignment["motion_mm"]:
        pair, motion = max(alignment["motion_mm"].items(), key=lambda item: item[1])
        figures |= {
            "overlap_rms_before_mm": _round(alignment["rms_before_mm"]),
            "overlap_rms_after_mm": _round(alignment["rms_after_mm"]),
            "sway_mm": _round(motion),
            "sway_pair": pair,
        }
    return figures


def _collect_rig_figures(content: Mapping[str, Any]) -> dict[str, Any]:
    if not content:
        return {}
    qualities = [pair["quality"] for pair in content["pairs"].values()]
    corners = [q["corners_rms_px"] for q in qualities if q["corners_rms_px"] is not None]
    sheets = [q["planes_rms_mm"] for q in qualities if q["planes_rms_mm"] is not None]
    return {
        "pairs": len(qualities),
        "pairs_failed": " ".join(sorted(content["failed"])),
        "corners_rms_px": _round(max(corners)) if corners else None,
        "sheets_rms_mm": _round(max(sheets)) if sheets else None,
    }


def _read_facts(job: Job) -> dict[str, Any]:
    """Facts about the job's scan; empty if it has none."""
    return read_record(job.folder / "scan" / "scan.json")


def pair_motions(job: Job) -> dict[str, Array]:
    """Motion (3,) mm of every pair at the body's centre, from its calibrated to its aligned pose."""
    alignment = _read_facts(job).get("alignment")
    if not alignment or job.calibration is None:
        return {}
    calibrated = read_record(job.calibration / "calibration.json").get("pairs", {})
    motions = {}
    for pair, matrix in alignment["rig_from_camera"].items():
        if pair in calibrated and pair not in alignment["refused"]:
            before = np.asarray(calibrated[pair]["rig_from_camera"], float)
            change = np.asarray(matrix, float) @ np.linalg.inv(before)
            motions[pair] = change[:3, :3] @ BODY_CENTRE_MM + change[:3, 3] - BODY_CENTRE_MM
    return motions


def _round(value: float | None, digits: int = 4) -> float | None:
    return None if value is None else round(value, digits)
