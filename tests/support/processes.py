"""Waiting for what other processes do."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any


def wait_for(find: Callable[[], Any], seconds: float = 30.0) -> Any:
    """What is found, as soon as it counts as true."""
    end = time.monotonic() + seconds
    while not (found := find()):
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.02)
    return found


def told_of(process: int) -> list[str]:
    """Its state, its parent's number and so on, as Linux tells; empty if there is no such process."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    except (FileNotFoundError, ProcessLookupError):
        return []


def has_ended(process: int) -> bool:
    """Also if nobody has looked yet."""
    return told_of(process)[:1] in ([], ["Z"])
