"""Cores and memory shared out."""

from __future__ import annotations

import pytest

from bodyscan.jobs.batch import allocate
from bodyscan.settings import Resources

NEEDS = Resources(threads=2, memory_mb=4000)


@pytest.mark.parametrize(
    ("jobs", "workers", "cores_", "memory_mb", "wanted"),
    [
        (40, None, 16, 100_000, (8, 2)),  # by cores
        (40, None, 16, 13_000, (3, 2)),  # by memory
        (40, None, 1, 2_000, (1, 1)),  # there is always one
        (3, None, 16, 100_000, (3, 2)),  # no more than jobs
        (40, 16, 16, 100_000, (16, 1)),  # as asked for, with fewer threads
        (40, 16, 16, 13_000, (3, 2)),  # but never more memory than there is
        (40, 1, 16, 100_000, (1, 2)),
    ],
)
def test_shares(
    jobs: int, workers: int | None, cores_: int, memory_mb: int, wanted: tuple[int, int]
) -> None:
    shares = allocate(NEEDS, jobs, workers, cores_, memory_mb)
    assert (shares.workers, shares.threads) == wanted
