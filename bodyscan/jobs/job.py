"""A job: its folder with job.json, state, log and results; and the jobs of a folder of scans."""

from __future__ import annotations

import hashlib
import json
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bodyscan.captures.captures_file import FILE_NAME as CAPTURES
from bodyscan.errors import BadInput, ResultError
from bodyscan.files.atomic import write_json
from bodyscan.files.hashing import list_relative_files
from bodyscan.files.yaml_file import YamlError, read_yaml
from bodyscan.jobs.pipeline import Pipeline

JOB, STATE, LOG, LOCK, MANIFEST = "job.json", "state.json", "log.txt", "lock", "manifest.json"
KEPT = "kept-"  # begins the name of a folder with what people added to a result that is gone
STAGE = "stage.json"  # in every stage's folder: what it was made from, and its hashes
SUMMARY, MEASURES, BATCH_LOCK = "summary.csv", "measures.csv", "batch.lock"


@dataclass(frozen=True)
class Job:
    """One scan to be fused, or one rig to be calibrated."""

    name: str
    folder: Path  # where it is worked on
    source: Path  # the scan's folder, or the rig file's
    calibration: Path | None  # what calibrate-rig wrote; None for a rig
    pipeline: Pipeline
    until: str  # the last stage wanted
    # The pseudonym in the scan's captures.yaml; without one, the name of the scan's folder, so that
    # `bodyscan forget` finds every scan. None for a rig.
    subject: str | None = None


def make_job_name(folder_name: str) -> str:
    """Derive a job's name from that of its scan's folder: unchanged, or its plain letters and a hash.

    A name with quotes, line breaks or other alphabets thus is safe in every file system and table.
    """
    reserved = (MANIFEST, SUMMARY, MEASURES, BATCH_LOCK)
    plain_name = re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,63}", folder_name)
    if plain_name and folder_name not in reserved:
        return folder_name
    plain = re.sub(r"[^A-Za-z0-9]+", "-", folder_name).strip("-")[:40] or "scan"
    return f"{plain}-{hashlib.sha256(os.fsencode(folder_name)).hexdigest()[:8]}"


def write_job(job: Job) -> None:
    """Write job.json; paths are relative to the job's folder, so that everything may move together.

    Raises BadInput if there is a link in place of the folder: it may lead anywhere.
    """
    if job.folder.is_symlink() or (job.folder.exists() and not job.folder.is_dir()):
        raise BadInput(
            "is a link or a file where a job's folder should be",
            where=str(job.folder),
            remedy="take it away, or give another --out",
        )
    job.folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    write_json(
        job.folder / JOB,
        {
            "schema": "bodyscan-job",
            "version": 1,
            "name": job.name,
            "source": os.path.relpath(job.source, job.folder),
            "calibration": job.calibration and os.path.relpath(job.calibration, job.folder),
            "pipeline": job.pipeline.model_dump(mode="json", exclude_unset=True),
            "until": job.until,
            "subject": job.subject,
        },
    )


def read_job(folder: Path) -> Job:
    """Read what `write_job` wrote. Raises ResultError if it is not readable."""
    try:
        content = json.loads((folder / JOB).read_text("utf-8"))
        calibration = content["calibration"]
        return Job(
            content["name"],
            folder,
            _resolve(folder, content["source"]),
            _resolve(folder, calibration) if calibration else None,
            Pipeline.model_validate_json(json.dumps(content["pipeline"])),
            content["until"],
            content["subject"],
        )
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ResultError(
            f"is not a readable job ({type(error).__name__}: {error})",
            where=str(folder / JOB),
            remedy="start the batch again: it rewrites this file",
        ) from error


def read_record(path: Path) -> dict[str, Any]:
    """Read the JSON object in a file; empty if it is missing or unreadable."""
    try:
        content = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}


def list_results_in(folder: Path) -> dict[str, Path]:
    """The files that a stage wrote, as far as they exist, by relative path; not what people added."""
    named = read_record(folder / STAGE).get("outputs")
    if not isinstance(named, dict):
        return {}
    return {name: path for name, path in list_relative_files(folder).items() if name in named}


def _resolve(folder: Path, relative: str) -> Path:
    return Path(os.path.normpath(folder.absolute() / relative))


CALIBRATION = "calibration.json"
RESULTS = (CALIBRATION, "scan.json")
"""Files that mark a folder as written by bodyscan rather than by cameras."""
RIG_FILE = "rig.yaml"


def find_jobs(
    pipeline: Pipeline, scans: Path, out: Path, calibration: Path | None, until: str
) -> list[Job]:
    """Make one job for every scan (or rig) in `scans`, sorted by name.

    calibration: None for the nearest `calibration` folder: in `scans`, beside it or above it.

    Raises BadInput if there is no scan, or no calibration for scans.
    """
    if not scans.is_dir():
        raise BadInput("there is no such folder", where=str(scans), remedy="check --scans")
    if pipeline.kind == "fuse":
        sources, what = _find_scans(scans, out), "scan folder"
        calibration = calibration or find_nearest_calibration(scans)
    else:
        sources, what, calibration = _find_rigs(scans, out), f"folder with a {RIG_FILE}", None
    if not sources:
        raise BadInput(f"holds no {what}", where=str(scans), remedy="check --scans")
    return [make_job(path, pipeline, out, calibration, until) for path in sources]


def make_job(
    path: Path, pipeline: Pipeline, out: Path, calibration: Path | None, until: str
) -> Job:
    """Make the job of one scan's (or rig's) folder."""
    name, subject = make_job_name(path.name), _read_captures_content(path).get("subject")
    if not isinstance(subject, str):
        subject = path.name if pipeline.kind == "fuse" else None
    return Job(name, out.absolute() / name, path, calibration, pipeline, until, subject)


def _find_scans(scans: Path, out: Path) -> list[Path]:
    """Every folder except hidden ones, results, and captures that say they are not a scan.

    A folder that cannot be read as a scan is a job too: its failure must be reported.
    """
    if (scans / CAPTURES).exists():
        return [scans.absolute()]
    return [
        path
        for path in _find_folders(scans, out)
        if not any((path / name).exists() for name in RESULTS)
        and _read_captures_content(path).get("kind") != "calibration"
    ]


def _find_rigs(folder: Path, out: Path) -> list[Path]:
    if (folder / RIG_FILE).exists():
        return [folder.absolute()]
    return [path for path in _find_folders(folder, out) if (path / RIG_FILE).exists()]


def _find_folders(folder: Path, out: Path) -> list[Path]:
    results = os.path.realpath(out)
    if out.is_dir() and any(out.iterdir()) and not (out / BATCH_LOCK).exists():
        results = ""  # a folder of images, which `require_writable` refuses
    return [
        path
        for path in sorted(folder.absolute().iterdir())
        if path.is_dir() and not path.name.startswith(".") and os.path.realpath(path) != results
    ]


def _read_captures_content(folder: Path) -> dict[str, Any]:
    """The folder's captures.yaml, unchecked; empty if it cannot be read."""
    try:
        data = read_yaml(folder / CAPTURES).data
    except (YamlError, OSError, RecursionError):
        return {}
    return data if isinstance(data, dict) else {}


def find_nearest_calibration(scans: Path) -> Path:
    """The `calibration` folder in the scans' folder, beside it or above it. Raises BadInput."""
    absolute = scans.absolute()
    for above in (absolute, *list(absolute.parents)[:2]):
        if (above / "calibration" / CALIBRATION).exists():
            return above / "calibration"
    raise BadInput(
        f"no calibration/{CALIBRATION} lies in this folder, beside it or above it",
        where=str(scans),
        remedy="name what `bodyscan calibrate-rig` wrote with --calibration",
    )
