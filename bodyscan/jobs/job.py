"""One job: a folder that holds what to do (job.json), its state, its log and its results."""

from __future__ import annotations

import hashlib
import json
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bodyscan.errors import BadInput, ResultError
from bodyscan.files.atomic import write_json
from bodyscan.files.hashing import list_relative_files
from bodyscan.jobs.pipeline import Pipeline

SCHEMA, VERSION = "bodyscan-job", 1
JOB, STATE, LOG, LOCK, MANIFEST = "job.json", "state.json", "log.txt", "lock", "manifest.json"
KEPT = "kept-"  # begins the name of a folder with what people added to a result that is gone
STAGE = "stage.json"  # in every stage's folder: what it was made from, and its hashes
SUMMARY, BATCH_LOCK = "summary.csv", "batch.lock"

_PLAIN = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,63}")
_TAKEN = {MANIFEST, SUMMARY, BATCH_LOCK}


@dataclass(frozen=True)
class Job:
    """One scan to be fused, or one rig to be calibrated.

    folder: where it is worked on.
    source: the scan's folder, or the rig file's.
    calibration: what calibrate-rig wrote; None for a rig.
    until: the last stage wanted.
    subject: the pseudonym in the scan's captures.yaml, never derived from a name.
    """

    name: str
    folder: Path
    source: Path
    calibration: Path | None
    pipeline: Pipeline
    until: str
    subject: str | None = None


def job_name(folder_name: str) -> str:
    """A job's name from that of its scan's folder: unchanged, or its plain letters and a hash.

    A name with quotes, line breaks or other alphabets thus is safe in every file system and table.
    """
    if _PLAIN.fullmatch(folder_name) and folder_name not in _TAKEN:
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
            "schema": SCHEMA,
            "version": VERSION,
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
            _there(folder, content["source"]),
            _there(folder, calibration) if calibration else None,
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
    """The JSON object in a file; empty if it is missing or unreadable."""
    try:
        content = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}


def results_in(folder: Path) -> dict[str, Path]:
    """What a stage wrote, as far as it is there, by relative path: people may have added files."""
    named = read_record(folder / STAGE).get("outputs")
    if not isinstance(named, dict):
        return {}
    return {name: path for name, path in list_relative_files(folder).items() if name in named}


def _there(folder: Path, relative: str) -> Path:
    return Path(os.path.normpath(folder.absolute() / relative))


def printable(text: str) -> str:
    """Text that cannot disturb a terminal or a table: control characters are spelt out."""
    return "".join(
        letter if letter.isprintable() or letter == "\n" else ascii(letter)[1:-1] for letter in text
    )
