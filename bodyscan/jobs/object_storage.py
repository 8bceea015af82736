"""Scans and results in object storage (s3://, gs://, abfs:// and whatever else fsspec opens).

A job's inputs and existing results are fetched into a folder of the machine that works on it, the
usual job command runs there, and what is new is put back; stage.json, which vouches for a stage's
files by their hashes, comes last. So an interrupted upload is never mistaken for a result. Object
storage has no locks: running one batch at a time is up to the user.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

from bodyscan.captures.captures_file import FILE_NAME as CAPTURES
from bodyscan.errors import BadInput, BodyscanError, FailedWork
from bodyscan.files.atomic import scratch_folder
from bodyscan.files.hashing import list_files
from bodyscan.jobs.job import (
    KEPT,
    LOCK,
    MANIFEST,
    MEASURES,
    STAGE,
    SUMMARY,
    Job,
    find_jobs,
    write_job,
)
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

    Raises BadInput as `find_jobs` does, if nothing is there, or if fsspec cannot open the store;
    FailedWork if it does not answer.
    """
    (work / "scans").mkdir(parents=True)
    with _answering(store.out):
        files = _open(store.out)
        bucket = files.path.partition("/")[0]  # "" where a store has none: paths begin with "/"
        if bucket and not files.fs.exists(bucket):  # mistyped, and the summary would make it
            raise _not_there(store.out)
    with _answering(store.scans):
        files = _open(store.scans)
        for entry in files.ls("", detail=True) if files.exists("") else ():
            if entry["type"] == "directory":
                _resolve_inside(work / "scans", entry["name"]).mkdir()
                for small in (f"{entry['name']}/{name}" for name in (CAPTURES, "rig.yaml")):
                    _fetch_one(files, small, work / "scans" / small)
    _require_some(store.scans, work / "scans")
    calibration = None
    if store.calibration is not None:
        calibration = work / "calibration"
        with _answering(store.calibration):
            _fetch(store.calibration, calibration)
        _require_some(store.calibration, calibration)
    return find_jobs(pipeline, work / "scans", work / "out", calibration, until)


def _require_some(url: str, fetched: Path) -> None:
    if not any(fetched.iterdir()):
        raise _not_there(url)


def _not_there(url: str) -> BadInput:
    remedy = "check the URL: does the bucket exist, and may this account list it?"
    return BadInput("holds nothing, or is not there", where=url, remedy=remedy)


@contextmanager
def _answering(url: str) -> Iterator[None]:
    """Raise FailedWork for whatever a store's library raises: as many kinds as there are stores."""
    try:
        yield
    except (BodyscanError, MemoryError):
        raise
    except FileNotFoundError as error:
        raise _not_there(url) from error
    except Exception as error:
        first = str(error).strip().partition("\n")[0]
        raise FailedWork(
            f"the store does not answer ({type(error).__name__}: {first})",
            where=url,
            remedy="check the network, the server and the credentials, then start the same batch "
            "again: jobs that are done stay done",
        ) from error


def work_on_stored(
    job: Job, process: JobProcess, listen: Listen = ignore_events, *, store: Store
) -> JobResult:
    """Fetch a job, bring it up to date, and put back what is new; return failures, never raise them."""
    try:
        with _answering(store.job(job.name)), scratch_folder() as work:
            local = replace(
                job,
                folder=work / "out" / job.name,
                source=work / "scans" / job.source.name,
                calibration=work / "calibration" if store.calibration else None,
            )
            _fetch(f"{store.scans.rstrip('/')}/{job.source.name}", local.source)
            if store.calibration:
                _fetch(store.calibration, work / "calibration")
            _fetch(store.job(job.name), local.folder)
            was = _read_stages(local.folder)
            write_job(local)
            outcome = supervise_job(local, process, listen)
            _put_back(local.folder, _open(store.job(job.name)), was, outcome.stages)
            return outcome
    except BodyscanError as error:
        return JobResult(job.name, "set aside", reason=str(error))


def fetch_figures(jobs: Sequence[Job], store: Store) -> None:
    """Fetch what the summary needs of every job into the outline."""
    for job in jobs:
        with _answering(store.job(job.name)):
            files = _open(store.job(job.name))
            results = ("scan/scan.json", f"measures/{MEASURES}", "calibration/calibration.json")
            for name in (*results, MANIFEST):
                _fetch_one(files, name, job.folder / name)


def put_summary(out: Path, store: Store) -> str:
    """Put back the table and the manifest over all jobs; returns the table's URL."""
    with _answering(store.out):
        files = _open(store.out)
        for name in (SUMMARY, MANIFEST):
            _put(files, name, out / name)
        if (out / MEASURES).exists():
            _put(files, MEASURES, out / MEASURES)
    return store.job(SUMMARY)


def _read_stages(folder: Path) -> dict[str, bytes]:
    return {path.parent.name: path.read_bytes() for path in folder.glob(f"*/{STAGE}")}


def _put_back(folder: Path, there: Any, was: dict[str, bytes], ran: tuple[str, ...]) -> None:
    """Put back results. was: the stages as fetched. ran: those made again, perhaps identical."""

    def put(paths: Iterable[Path], last: str) -> None:
        for path in sorted(paths, key=lambda path: (path.name == last, path)):
            _put(there, path.relative_to(folder).as_posix(), path)

    for kept in folder.glob(f"{KEPT}*"):
        put(list_files(kept), "")  # before what it is taken from goes
    now = _read_stages(folder)
    for stage in sorted(was.keys() | now.keys()):
        if stage in ran or now.get(stage) != was.get(stage):
            if there.exists(stage):
                there.rm(stage, recursive=True)
            put(list_files(folder / stage), STAGE)
    put((path for path in folder.iterdir() if path.is_file() and path.name != LOCK), MANIFEST)


def _open(url: str) -> Any:
    """The files below a URL, as fsspec's file system with names relative to it."""
    try:
        import fsspec
        from fsspec.implementations.dirfs import DirFileSystem
    except ImportError:
        raise BadInput(
            "object storage needs fsspec, which is not installed",
            where=url,
            remedy="pip install 'bodyscan[cluster]', and what fsspec needs for this store",
        ) from None
    try:
        system, root = fsspec.core.url_to_fs(url)
    except (ImportError, ValueError) as error:
        raise BadInput(
            f"cannot be opened: {error}", where=url, remedy="install what fsspec asks for"
        ) from error
    return DirFileSystem(str(root).rstrip("/"), system)


def _fetch(url: str, folder: Path) -> None:
    """Fetch every file below a URL to its place in `folder`."""
    files = _open(url)
    folder.mkdir(parents=True, exist_ok=True)
    for name in sorted(files.find("")):
        _fetch_one(files, name, _resolve_inside(folder, name))


def _fetch_one(files: Any, name: str, path: Path) -> None:
    """Fetch one file if it exists."""
    if files.isfile(name):
        path.parent.mkdir(parents=True, exist_ok=True)
        files.get_file(name, str(path))


def _put(files: Any, name: str, path: Path) -> None:
    files.makedirs(str(PurePosixPath(name).parent), exist_ok=True)
    files.put_file(str(path), name)


def _resolve_inside(folder: Path, name: str) -> Path:
    """The path of an object; names may be any text, but none may lead out of the folder."""
    parts = PurePosixPath(name).parts
    if not parts or name.startswith("/") or ".." in parts:
        raise BadInput(f"the object's name {name!r} leads out of its folder", where=str(folder))
    return folder.joinpath(*parts)
