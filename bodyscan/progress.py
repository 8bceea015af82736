"""How stages report progress: they call a plain function; the command line draws the bar."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
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
    work: Callable[[Item], Result], items: Iterable[Item], *, workers: int = THREADS
) -> list[Result]:
    """Run `work` on every item in threads; return the results in the order of the items."""
    with ThreadPoolExecutor(workers) as pool:
        return list(pool.map(work, items))


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
    good: dict[Item, Result] = {}
    bad: dict[Item, Error] = {}

    def attempt(item: Item) -> None:
        try:
            good[item] = work(item)
        except error as found:
            bad[item] = found

    todo = list(items)
    progress(stage, 0, len(todo))
    with ThreadPoolExecutor(workers) as pool:
        for done, _ in enumerate(pool.map(attempt, todo), start=1):
            progress(stage, done, len(todo))
    results = {item: good[item] for item in todo if item in good}
    return results, {item: bad[item] for item in todo if item in bad}
