"""Scans and results in object storage (s3://, gs://, abfs:// and whatever else fsspec opens).

A job's inputs and existing results are fetched into a folder of the machine that works on it, the
usual job command runs there, and what is new is put back; stage.json, which vouches for a stage's
files by their hashes, comes last. So an interrupted upload is never mistaken for a result. Object
storage has no locks: running one batch at a time is up to the user.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

from bodyscan.captures.captures_file import FILE_NAME as CAPTURES
from bodyscan.errors import BadInput
from bodyscan.files.hashing import list_files
from bodyscan.jobs.job import KEPT, LOCK, MANIFEST, STAGE, SUMMARY, Job, find_jobs, write_job
from bodyscan.jobs.pipeline import Pipeline
from bodyscan.jobs.supervision import JobProcess, JobResult, Listen, ignore_events, supervise_job


def is_url(place: str) -> bool:
    """Whether a place is a URL rather than a path."""
    return "://" in place


@dataclass(frozen=True)
class Store:
    """URLs of the folder of scans, of the output folder, and of the calibration (None for rigs)."""

    scans: str
    out: str
    calibration: str | None

    def job(self, name: str) -> str:
        """URL of a job's folder."""
        return f"{self.out.rstrip('/')}/{name}"


def find_stored_jobs(store: Store, pipeline: Pipeline, until: str, work: Path) -> list[Job]:
    """The jobs of a store; `work`, an empty local folder, receives an outline of it.

    Raises BadInput as `find_jobs` does, or if fsspec cannot open the store.
    """
    files = _Files(store.scans)
    for name in files.folders():
        (_inside(work / "scans", name)).mkdir(parents=True)
        for small in (CAPTURES, "rig.yaml"):
            files.fetch_one(f"{name}/{small}", work / "scans" / name / small)
    (work / "scans").mkdir(exist_ok=True)
    calibration = None
    if store.calibration is not None:
        calibration = work / "calibration"
        _Files(store.calibration).fetch(calibration)
    return find_jobs(pipeline, work / "scans", work / "out", calibration, until)


def work_on_stored(
    job: Job, process: JobProcess, listen: Listen = ignore_events, *, store: Store
) -> JobResult:
    """Fetch a job, bring it up to date, and put back what is new; return failures, never raise them."""
    try:
        with tempfile.TemporaryDirectory(prefix="bodyscan-") as folder:
            work = Path(folder)
            local = replace(
                job,
                folder=work / "out" / job.name,
                source=work / "scans" / job.source.name,
                calibration=work / "calibration" if store.calibration else None,
            )
            _Files(f"{store.scans.rstrip('/')}/{job.source.name}").fetch(local.source)
            if store.calibration:
                _Files(store.calibration).fetch(work / "calibration")
            there = _Files(store.job(job.name))
            there.fetch(local.folder)
            was = _stages(local.folder)
            write_job(local)
            outcome = supervise_job(local, process, listen)
            _put_back(local.folder, there, was, outcome.stages)
            return outcome
    except Exception as error:  # a store fails in as many ways as there are stores
        return JobResult(job.name, "set aside", reason=f"{type(error).__name__}: {error}")


def fetch_figures(jobs: Sequence[Job], store: Store) -> None:
    """Fetch what the summary needs of every job into the outline."""
    for job in jobs:
        files = _Files(store.job(job.name))
        for name in ("scan/scan.json", "calibration/calibration.json", MANIFEST):
            files.fetch_one(name, job.folder / name)


def put_summary(out: Path, store: Store) -> str:
    """Put back the table and the manifest over all jobs; returns the table's URL."""
    files = _Files(store.out)
    for name in (SUMMARY, MANIFEST):
        files.put(out / name, name)
    return store.job(SUMMARY)


def _stages(folder: Path) -> dict[str, bytes]:
    return {path.parent.name: path.read_bytes() for path in folder.glob(f"*/{STAGE}")}


def _put_back(folder: Path, there: _Files, was: dict[str, bytes], ran: tuple[str, ...]) -> None:
    """Put back results. was: the stages as fetched. ran: those made again, perhaps identical."""
    for path in sorted(path for kept in folder.glob(f"{KEPT}*") for path in list_files(kept)):
        there.put(path, path.relative_to(folder).as_posix())  # before what it is taken from goes
    now = _stages(folder)
    for stage in was.keys() - now.keys():
        there.remove(stage)
    for stage in sorted(now):
        if stage in ran or now[stage] != was.get(stage):
            there.remove(stage)
            paths = sorted(list_files(folder / stage), key=lambda path: path.name == STAGE)
            for path in paths:
                there.put(path, path.relative_to(folder).as_posix())
    for path in sorted(folder.iterdir(), key=lambda path: path.name == MANIFEST):
        if path.is_file() and path.name != LOCK:
            there.put(path, path.name)


class _Files:
    """The files below one URL."""

    def __init__(self, url: str) -> None:
        try:
            import fsspec
        except ImportError:
            raise BadInput(
                "object storage needs fsspec, which is not installed",
                where=url,
                remedy="pip install 'bodyscan[cluster]', and what fsspec needs for this store",
            ) from None
        try:
            self._system, root = fsspec.core.url_to_fs(url)
        except (ImportError, ValueError) as error:
            raise BadInput(
                f"cannot be opened: {error}", where=url, remedy="install what fsspec asks for"
            ) from error
        self._root = str(root).rstrip("/")

    def folders(self) -> list[str]:
        """Names of the folders at the top."""
        if not self._system.exists(self._root):
            return []
        listed: list[dict[str, Any]] = self._system.ls(self._root, detail=True)
        names = [PurePosixPath(e["name"]).name for e in listed if e["type"] == "directory"]
        return sorted(names)

    def fetch(self, folder: Path) -> None:
        """Fetch every file to its place below `folder`."""
        folder.mkdir(parents=True, exist_ok=True)
        for name in self._names():
            self.fetch_one(name, _inside(folder, name))

    def fetch_one(self, name: str, path: Path) -> None:
        """Fetch one file if it exists."""
        if self._system.isfile(f"{self._root}/{name}"):
            path.parent.mkdir(parents=True, exist_ok=True)
            self._system.get_file(f"{self._root}/{name}", str(path))

    def put(self, path: Path, name: str) -> None:
        self._system.makedirs(str(PurePosixPath(self._root, name).parent), exist_ok=True)
        self._system.put_file(str(path), f"{self._root}/{name}")

    def remove(self, name: str) -> None:
        if self._system.exists(f"{self._root}/{name}"):
            self._system.rm(f"{self._root}/{name}", recursive=True)

    def _names(self) -> list[str]:
        if not self._system.exists(self._root):
            return []
        root = self._root.lstrip("/") + "/"
        found = (str(path).lstrip("/") for path in self._system.find(self._root))
        return sorted(path.removeprefix(root) for path in found if path.startswith(root))


def _inside(folder: Path, name: str) -> Path:
    """The path of an object; names may be any text, but none may lead out of the folder."""
    parts = PurePosixPath(name).parts
    if not parts or name.startswith("/") or ".." in parts:
        raise BadInput(f"the object's name {name!r} leads out of its folder", where=str(folder))
    return folder.joinpath(*parts)
