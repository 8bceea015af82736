"""How stages report progress: they call a plain function; the command line draws the bar."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

THREADS = 2
"""Threads that a stage uses, and cores that a job of a batch takes. All times in docs/results.md
were measured with it; larger machines run more jobs side by side."""

Progress = Callable[[str, int, int], None]
Item = TypeVar("Item")
Result = TypeVar("Result")
Error = TypeVar("Error", bound=Exception)


def silent(stage: str, done: int, total: int) -> None:
    """A `Progress` that reports nothing."""


@contextmanager
def step(progress: Progress, stage: str) -> Iterator[None]:
    """Report that a stage begins and, unless it raises, that it is done."""
    progress(stage, 0, 1)
    yield
    progress(stage, 1, 1)


def background() -> ThreadPoolExecutor:
    """One more thread beside the caller's, which runs what is submitted to it in that order.

    For work on one core while stages keep the other busy. Leaving the `with` block waits for it.
    """
    return ThreadPoolExecutor(1)


def map_threads(
    work: Callable[[Item], Result],
    items: Iterable[Item],
    *,
    stage: str,
    progress: Progress = silent,
    workers: int = THREADS,
) -> list[Result]:
    """Run `work` on every item in threads; return the results in the order of the items."""
    todo: Sequence[Item] = list(items)
    progress(stage, 0, len(todo))
    results = []
    with ThreadPoolExecutor(workers) as pool:
        for done, result in enumerate(pool.map(work, todo), start=1):
            results.append(result)
            progress(stage, done, len(todo))
    return results


def attempt_each(
    work: Callable[[Item], Result],
    items: Iterable[Item],
    error: type[Error],
    *,
    stage: str,
    progress: Progress = silent,
    workers: int = THREADS,
) -> tuple[dict[Item, Result], dict[Item, Error]]:
    """Run `work` on every item in threads; return results and errors of type `error`, by item."""
    bad: dict[Item, Error] = {}

    def attempt(item: Item) -> list[tuple[Item, Result]]:
        try:
            return [(item, work(item))]
        except error as found:
            bad[item] = found
            return []

    todo: Sequence[Item] = list(items)
    found = map_threads(attempt, todo, stage=stage, progress=progress, workers=workers)
    good = dict(one for each in found for one in each)
    return good, {item: bad[item] for item in todo if item in bad}


def split_range(count: int) -> list[slice]:
    """Split range(count) into THREADS slices of nearly equal length."""
    return [slice(k * count // THREADS, (k + 1) * count // THREADS) for k in range(THREADS)]
