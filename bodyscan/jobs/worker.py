"""The process of a job, or one that stays for many: works through the stages, so that a crash in
native code costs one job.

Results are made in a folder with another name, flushed to disk, and renamed: whatever has its
proper name is complete. The process reports progress to its parent on standard output, one JSON
object per line, and ends as soon as its parent is gone.
"""

from __future__ import annotations

import json
import logging
import os
import secrets
import shutil
import sys
import threading
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from importlib import import_module
from pathlib import Path
from queue import SimpleQueue
from typing import Any

from bodyscan.errors import BodyscanError, CaptureError
from bodyscan.files.atomic import flush, format_json, lock_file, restrict_to_owner, write_json
from bodyscan.files.hashing import (
    hash_content,
    hash_file,
    hash_files,
    list_files,
    list_relative_files,
)
from bodyscan.files.messages import translate_failure
from bodyscan.jobs.job import KEPT, LOCK, LOG, MANIFEST, STAGE, Job, list_results_in, read_job
from bodyscan.jobs.plan import Origin, describe_origin, find_reason_to_run
from bodyscan.jobs.stages import KINDS, Kinds, Stage, run_scan, select_stages_until
from bodyscan.jobs.supervision import open_log
from bodyscan.memory import keep_freed_memory, reserve_blas_memory
from bodyscan.progress import THREADS
from bodyscan.verdict import Verdict

Emit = Callable[..., None]

_BEING_MADE, _TAKEN_AWAY = ".making-", ".old-"


def main(kinds: Kinds = KINDS) -> int:
    """Do the job in the folder on the command line; 0: done, 2: bad input, 1: failed."""
    emit = _become_worker()
    _read_requests()
    reason, exit_code = _attempt(Path(sys.argv[1]), kinds, emit)
    emit(ended=sys.argv[1], failed=reason)
    return exit_code


def stay() -> int:
    """Answer requests for the calibration on the command line, until there is no one left to ask.

    A request is a JSON object on a line of standard input. With `pairs` it asks to decode those of
    a scan that is still arriving, without to do the job in `folder` as a process of its own would,
    with the same stages, locks and manifests; with `preview` it shows the cloud too. Returns 2 if
    the calibration cannot be used, 1 if there is no memory for it.
    """
    emit = _become_worker()
    requests = _read_requests()
    try:
        from bodyscan.fusion.storage import ignore_made
        from bodyscan.mesh.body import BodyCloud, BodyMesh
        from bodyscan.report.model import pack_cloud
        from bodyscan.workflows.range_images import Preparation

        reserve_blas_memory(THREADS)
        preparation = Preparation(Path(sys.argv[2]))
        # Now, not while someone waits for the first verdict.
        import_module("bodyscan.workflows.scan_person")
    except Exception as error:
        known = error if isinstance(error, BodyscanError) else translate_failure(error)
        if known is None:
            raise
        emit(unusable=str(known), exit_code=known.exit_code)
        return known.exit_code
    scan, *others = KINDS["fuse"]

    def show(body: BodyCloud | BodyMesh) -> None:
        if isinstance(body, BodyCloud):
            emit(cloud=pack_cloud(body))

    emit(ready=True)
    while True:
        request = requests.get()
        folder = Path(request["folder"])
        if "pairs" in request:
            preparation.prepare(folder, request["pairs"])
            continue
        made = show if request.get("preview") else ignore_made
        run = partial(run_scan, preparation=preparation, made=made)
        with _redirect_to_log(folder):
            reason, _ = _attempt(folder, {"fuse": (replace(scan, run=run), *others)}, emit)
        with suppress(BodyscanError):
            preparation.drop(read_job(folder).source)
        emit(ended=request["folder"], failed=reason)


def _attempt(folder: Path, kinds: Kinds, emit: Emit) -> tuple[str, int]:
    """Do the job; return why it failed, "" if it did not, and the exit code."""
    try:
        with restrict_to_owner():
            reserve_blas_memory(THREADS)
            _work(folder, kinds, emit)
    except BodyscanError as error:
        return str(error), error.exit_code
    except Exception as error:
        with suppress(OSError):  # the log is on that same disk
            traceback.print_exc()
        known = translate_failure(error)
        return str(known or f"{type(error).__name__}: {error}"), 1
    return "", 0


def _become_worker() -> Emit:
    """Set up a process of jobs; returns the function that reports to its parent. Standard output is the
    parent's alone; what libraries print there goes into the log."""
    keep_freed_memory()
    logging.basicConfig(format="%(message)s")  # on standard error, which is the job's log
    logging.getLogger("bodyscan").setLevel(logging.DEBUG)
    with suppress(OSError):  # if memory runs out: a job is tried again, a batch is not
        Path("/proc/self/oom_score_adj").write_text("900")
    stream = os.fdopen(os.dup(1), "w", encoding="utf-8", buffering=1)
    os.dup2(2, 1)
    lock = threading.Lock()

    def emit(**what: Any) -> None:
        with lock:
            stream.write(json.dumps(what) + "\n")

    return emit


def _work(folder: Path, kinds: Kinds, emit: Emit) -> None:
    """Bring a job's results up to date, waiting for anyone else at work on it."""
    with lock_file(folder / LOCK, wait=True):
        _tidy(folder, emit)
        job = read_job(folder)
        every = kinds[job.pipeline.kind]
        stages = select_stages_until(every, job.until)
        for stage in stages:
            now = describe_origin(job, stage)
            if why := find_reason_to_run(job, now):
                emit(stage=stage.name, why=why)
                _perform(job, stage, now, emit)
        for stage in every[len(stages) :]:
            # Remove results that were made from other results than are there now.
            results = job.folder / stage.name
            with suppress(BodyscanError, OSError):
                if results.exists() and find_reason_to_run(job, describe_origin(job, stage)):
                    _remove_results(_move_aside(results), emit)
        _write_manifest(job, every)


def _perform(job: Job, stage: Stage, before: Origin, emit: Emit) -> None:
    """Run a stage and put its results in place, if its inputs did not change meanwhile."""
    made = job.folder / f"{_BEING_MADE}{stage.name}-{secrets.token_hex(4)}"
    made.mkdir()

    def progress(part: str, done: int, total: int) -> None:
        emit(stage=stage.name, part=part, done=done, total=total)

    def announce(verdict: Verdict, *, final: bool) -> None:
        emit(grade=verdict.grade, reasons=verdict.reasons, final=final)

    try:
        stage.run(job, made, progress, announce)
        if hash_files(stage.inputs(job)) != before.inputs:
            remedy = "start the batch again when the folder is complete"
            raise CaptureError("changed while it was read", where=str(job.source), remedy=remedy)
        write_json(made / STAGE, before.record(hash_files(list_relative_files(made))))
        for path in (*list_files(made), made):  # to the disk, before a name says that it is there
            flush(path)
    except BaseException:
        shutil.rmtree(made, ignore_errors=True)
        raise
    # A folder cannot replace another in one step, so the old one is moved aside first.
    old = _move_aside(job.folder / stage.name)
    made.rename(job.folder / stage.name)
    flush(job.folder)
    _remove_results(old, emit)


def _move_aside(folder: Path) -> Path:
    old = folder.with_name(f"{_TAKEN_AWAY}{folder.name}-{secrets.token_hex(4)}")
    with suppress(FileNotFoundError):
        folder.rename(old)
    return old


def _remove_results(old: Path, emit: Emit) -> None:
    """Remove what a stage wrote, and its record last, so that this can be cut short at any moment.
    Anything else is a person's, made from the former result: it stays in a folder of its own."""
    token = old.name.removeprefix(_TAKEN_AWAY)
    stage = token.rpartition("-")[0]
    if old.is_dir() and not old.is_symlink():
        # Without a record (an upload that was cut short) the new result tells what stages write.
        ours = list_results_in(old) or list_results_in(old.with_name(stage))
        for name, path in list_relative_files(old).items():
            if name in ours:
                path.unlink()
        (old / STAGE).unlink(missing_ok=True)
        for folder, *_ in os.walk(old, topdown=False):
            with suppress(OSError):  # something is left in it
                os.rmdir(folder)
    if os.path.lexists(old):
        kept = old.rename(old.with_name(f"{KEPT}{token}"))
        print(f"files that were added to {stage} are now in {kept.name}", flush=True)  # the log
        emit(stage=stage, kept=kept.name)


def _write_manifest(job: Job, stages: Sequence[Stage]) -> None:
    """Write one file that ties inputs and results together, and contains its own hash. Results are
    listed by their path in the job's folder, inputs from outside by what they are for."""
    inputs: dict[str, str] = {}
    outputs: dict[str, str] = {}
    for stage in stages:
        path = job.folder / stage.name / STAGE
        if path.exists():
            record = json.loads(path.read_text("utf-8"))
            inputs |= record["inputs"]
            outputs |= {f"{stage.name}/{name}": h for name, h in record["outputs"].items()}
            outputs[f"{stage.name}/{STAGE}"] = hash_file(path)
    inputs = {name: value for name, value in inputs.items() if name not in outputs}
    content: dict[str, Any] = {"schema": "bodyscan-manifest", "version": 1}
    content |= {"inputs": inputs, "outputs": outputs}
    content["own_sha256"] = hash_content(content)
    path = job.folder / MANIFEST
    if not path.exists() or path.read_text("utf-8") != format_json(content):
        write_json(path, content)


def _tidy(folder: Path, emit: Emit) -> None:
    """Remove what an earlier process was making, or taking away, when it was killed."""
    for path in [*folder.iterdir()]:
        if path.name.startswith(_TAKEN_AWAY):
            _remove_results(path, emit)
        elif path.name.startswith(_BEING_MADE) or path.name.endswith(".tmp.json"):
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)


def _read_requests() -> SimpleQueue[dict[str, Any]]:
    """Requests, read by a thread; it ends this process with its parent, which holds the other end
    of standard input."""
    requests: SimpleQueue[dict[str, Any]] = SimpleQueue()

    def read() -> None:
        for line in sys.stdin:
            requests.put(json.loads(line))
        os._exit(1)

    threading.Thread(target=read, daemon=True).start()
    return requests


@contextmanager
def _redirect_to_log(folder: Path) -> Iterator[None]:
    """Send what is printed meanwhile to the job's log."""
    before = os.dup(2)
    try:
        with open_log(folder / LOG) as log:
            _send_output_to(log.fileno())
            yield
    finally:
        _send_output_to(before)
        os.close(before)


def _send_output_to(handle: int) -> None:
    sys.stdout.flush()
    sys.stderr.flush()
    os.dup2(handle, 1)
    os.dup2(handle, 2)
