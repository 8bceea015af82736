"""What is costly to make is made once for a whole run of tests, however many workers share it."""

from __future__ import annotations

import fcntl
import os
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import pytest

Value = TypeVar("Value")


def folder_made_once(
    factory: pytest.TempPathFactory, name: str, make: Callable[[Path], None]
) -> Path:
    """The folder that `make` fills; a worker that comes later waits until it is full. What was half
    made, by a worker that failed, is made again by the next, which then fails alike."""
    base = factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        base = base.parent  # each worker has a folder of its own in the run's
    folder, full = base / name, base / f"{name}.full"
    with (base / f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not full.exists():
            folder.mkdir(exist_ok=True)
            make(folder)
            full.touch()
    return folder


def value_made_once(factory: pytest.TempPathFactory, name: str, make: Callable[[], Value]) -> Value:
    """The value that `make` returns, kept in a file in between."""

    def keep(folder: Path) -> None:
        (folder / "value.pickle").write_bytes(pickle.dumps(make()))

    folder = folder_made_once(factory, name, keep)
    value: Value = pickle.loads((folder / "value.pickle").read_bytes())
    return value
