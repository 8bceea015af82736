"""Sharing memory and cores so that many jobs neither wait for each other nor run short."""

from __future__ import annotations

import os
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from bodyscan.settings import Resources


@dataclass(frozen=True)
class Allocation:
    """workers: jobs at the same time. threads: per job. why: what limits them, in words."""

    workers: int
    threads: int
    why: str


def allocate(
    resources: Resources, jobs: int, workers: int | None, cores: int, memory_mb: float
) -> Allocation:
    """As many jobs at once as cores and memory allow, but no more than there are.

    workers: a number requested by the user; more workers get fewer threads each, but never more
        memory than there is.
    """
    by_memory = max(1, int(memory_mb // resources.memory_mb))
    most = workers or max(1, cores // resources.threads)
    count = max(1, min(most, by_memory, jobs))
    threads = max(1, min(resources.threads, cores // count))
    why = f"{cores} cores, {memory_mb / 1000.0:.1f} GB free"
    if count == by_memory < min(most, jobs):
        why += f"; memory limits them, a job takes {resources.memory_mb / 1000.0:g} GB"
    return Allocation(count, threads, why)


def cores() -> int:
    """Number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def free_memory_mb() -> float:
    """Memory that is free on the machine, or left to this container, in MB (1e6 bytes)."""
    free = [float("inf")]
    with suppress(OSError, ValueError):
        for line in Path("/proc/meminfo").read_text("ascii").splitlines():
            if line.startswith("MemAvailable:"):
                free.append(int(line.split()[1]) * 1024 / 1e6)
    with suppress(OSError, ValueError):
        group = Path("/sys/fs/cgroup")
        limit = int((group / "memory.max").read_text("ascii"))
        free.append((limit - int((group / "memory.current").read_text("ascii"))) / 1e6)
    least = min(free)
    return least if least < float("inf") else 4000.0
