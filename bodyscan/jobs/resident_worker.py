"""The process that stays: `python -m bodyscan.jobs --resident CALIBRATION`, started by `watch`.

Requests, one JSON object per line on its standard input, ask it to decode pairs of a scan that is
still arriving, or to do a job as a process of its own would, with the same stages, locks and
manifests.
"""

from __future__ import annotations

import json
import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from importlib import import_module
from pathlib import Path
from queue import SimpleQueue
from typing import Any

from bodyscan.errors import BodyscanError
from bodyscan.jobs.job import LOG
from bodyscan.jobs.stages import KINDS, Kinds, run_scan
from bodyscan.jobs.supervision import open_log
from bodyscan.jobs.worker import attempt, become_worker
from bodyscan.workflows.range_images import Preparation


def main() -> int:
    """Answer requests until there is no one left to ask; 2 if the calibration cannot be used."""
    emit = become_worker()
    requests = _requests()
    try:
        preparation = Preparation(Path(sys.argv[2]))
    except BodyscanError as error:
        emit(unusable=str(error))
        return error.exit_code
    kinds = _kinds(preparation)
    # Now, not while someone waits for the first verdict.
    import_module("bodyscan.workflows.scan_person")
    emit(ready=True)
    while True:
        request = requests.get()
        folder = Path(request["folder"])
        if "pairs" in request:
            preparation.prepare(folder, request["pairs"])
            continue
        with _log_of(folder):
            failure = attempt(folder, kinds, emit)
        emit(ended=request["folder"], failed=failure.reason if failure else "")


def _kinds(preparation: Preparation) -> Kinds:
    """The usual stages, except that the scan uses what was prepared."""
    scan, *others = KINDS["fuse"]
    return {"fuse": (replace(scan, run=partial(run_scan, preparation=preparation)), *others)}


def _requests() -> SimpleQueue[dict[str, Any]]:
    """Requests, read by a thread; when the other end closes the process exits at once."""
    requests: SimpleQueue[dict[str, Any]] = SimpleQueue()

    def read() -> None:
        for line in sys.stdin:
            requests.put(json.loads(line))
        os._exit(1)

    threading.Thread(target=read, daemon=True).start()
    return requests


@contextmanager
def _log_of(folder: Path) -> Iterator[None]:
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
