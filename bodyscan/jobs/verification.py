"""Check every byte against the manifests: images, calibration, cloud, mesh, exports."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from bodyscan.errors import BadInput, BodyscanError
from bodyscan.files.hashing import hash_content, hash_file, list_files
from bodyscan.jobs.job import MANIFEST, STAGE, list_results_in, read_job, read_record
from bodyscan.jobs.stages import KINDS, Kinds


@dataclass(frozen=True)
class Verification:
    """files: how many were checked. faults: what has changed, one line each. added: files among
    results that no stage wrote."""

    files: int
    faults: tuple[str, ...]
    added: tuple[Path, ...] = ()


def verify(folder: Path, kinds: Kinds = KINDS) -> Verification:
    """Check a batch's output folder, or one job's. Raises BadInput if there is no manifest."""
    if not (folder / MANIFEST).exists():
        raise BadInput(
            f"holds no {MANIFEST}",
            where=str(folder),
            remedy="give the --out folder of a batch, or a job's folder in it",
        )
    checked = list(_verify_all(folder, kinds))
    faults = tuple(f"{path}: {fault}" for path, fault in checked if fault)
    added = []
    for record in sorted((*folder.glob(f"*/{STAGE}"), *folder.glob(f"*/*/{STAGE}"))):
        known = {record, *list_results_in(record.parent).values()}
        added += [path for path in list_files(record.parent) if path not in known]
    return Verification(len(checked), faults, tuple(added))


def _verify_all(folder: Path, kinds: Kinds) -> Iterator[tuple[Path, str]]:
    """Every file checked, with its fault, "" if sound: of a job's folder, or all jobs of a batch."""
    jobs = read_record(folder / MANIFEST).get("jobs")
    if not isinstance(jobs, dict):
        yield from _verify_job(folder, kinds)
        return
    for name, digest in sorted(jobs.items()):
        yield _compare_hash(folder / name / MANIFEST, digest)
        if (folder / name / MANIFEST).exists():
            yield from _verify_job(folder / name, kinds)
    for path in sorted(folder.glob(f"*/{MANIFEST}")):
        if path.parent.name not in jobs:
            yield path, "is in no list of jobs"


def _verify_job(folder: Path, kinds: Kinds) -> Iterator[tuple[Path, str]]:
    path = folder / MANIFEST
    content = read_record(path)
    try:
        stored = content.pop("own_sha256")
        inputs, outputs = dict(content["inputs"]), dict(content["outputs"])
    except (KeyError, TypeError, ValueError):
        yield path, "is not a manifest"
        return
    yield path, "" if hash_content(content) == stored else "was changed"
    for name, digest in outputs.items():
        yield _compare_hash(folder / name, digest)
    try:
        job = read_job(folder)
        there = kinds[job.pipeline.kind][0].inputs(job)
    except BodyscanError as error:
        yield folder, f"its inputs cannot be read: {error}"
        return
    for name, digest in inputs.items():
        yield _compare_hash(there.get(name) or job.source / name.removeprefix("captures/"), digest)
    for name in there.keys() - inputs.keys():
        yield there[name], "is new: the job did not read it"


def _compare_hash(path: Path, digest: str) -> tuple[Path, str]:
    """The file, and how it differs from its hash; "" if it does not."""
    try:
        return path, "" if hash_file(path) == digest else "was changed"
    except FileNotFoundError:
        return path, "is gone"
    except (OSError, BodyscanError) as error:
        return path, f"cannot be read: {error}"
