"""Which jobs a folder of scans, or of rigs, holds."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from bodyscan.captures.captures_file import FILE_NAME as CAPTURES
from bodyscan.errors import BadInput
from bodyscan.files.yaml_file import YamlError, read_yaml
from bodyscan.jobs.job import Job, job_name
from bodyscan.jobs.pipeline import Pipeline

CALIBRATION = "calibration.json"
RESULTS = (CALIBRATION, "scan.json")
"""Files that mark a folder as written by bodyscan rather than by cameras."""
RIG_FILE = "rig.yaml"


def find_jobs(
    pipeline: Pipeline, scans: Path, out: Path, calibration: Path | None, until: str
) -> list[Job]:
    """One job for every scan (or rig) in `scans`, sorted by name.

    calibration: None for the nearest `calibration` folder: in `scans`, beside it or above it.

    Raises BadInput if there is no scan, or no calibration for scans.
    """
    if not scans.is_dir():
        raise BadInput("there is no such folder", where=str(scans), remedy="check --scans")
    if pipeline.kind == "fuse":
        sources, what = _scans(scans, out), "scan folder"
        calibration = calibration or nearest_calibration(scans)
    else:
        sources, what, calibration = _rigs(scans, out), f"folder with a {RIG_FILE}", None
    if not sources:
        raise BadInput(f"holds no {what}", where=str(scans), remedy="check --scans")
    return [job_of(path, pipeline, out, calibration, until) for path in sources]


def job_of(path: Path, pipeline: Pipeline, out: Path, calibration: Path | None, until: str) -> Job:
    """The job of one scan's (or rig's) folder."""
    name, subject = job_name(path.name), _captures_content(path).get("subject")
    subject = subject if isinstance(subject, str) else None
    return Job(name, out.absolute() / name, path, calibration, pipeline, until, subject)


def _scans(scans: Path, out: Path) -> list[Path]:
    """Every folder except hidden ones, results, and captures that say they are not a scan.

    A folder that cannot be read as a scan is a job too: its failure must be reported.
    """
    if (scans / CAPTURES).exists():
        return [scans.absolute()]
    return [
        path
        for path in _folders(scans, out)
        if not any((path / name).exists() for name in RESULTS)
        and _captures_content(path).get("kind") != "calibration"
    ]


def _rigs(folder: Path, out: Path) -> list[Path]:
    if (folder / RIG_FILE).exists():
        return [folder.absolute()]
    return [path for path in _folders(folder, out) if (path / RIG_FILE).exists()]


def _folders(folder: Path, out: Path) -> list[Path]:
    own = os.path.realpath(out)
    return [
        path
        for path in sorted(folder.absolute().iterdir())
        if path.is_dir() and not path.name.startswith(".") and os.path.realpath(path) != own
    ]


def _captures_content(folder: Path) -> dict[str, Any]:
    """The folder's captures.yaml, unchecked; empty if it cannot be read."""
    try:
        data = read_yaml(folder / CAPTURES).data
    except (YamlError, OSError, RecursionError):
        return {}
    return data if isinstance(data, dict) else {}


def nearest_calibration(scans: Path) -> Path:
    """The `calibration` folder in the folder of the scans, beside it or above it. Raises
    BadInput."""
    absolute = scans.absolute()
    for above in (absolute, *list(absolute.parents)[:2]):
        if (above / "calibration" / CALIBRATION).exists():
            return above / "calibration"
    raise BadInput(
        f"no calibration/{CALIBRATION} lies in this folder, beside it or above it",
        where=str(scans),
        remedy="name what `bodyscan calibrate-rig` wrote with --calibration",
    )
