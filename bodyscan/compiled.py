"""Loops over pixels that would take numpy many passes, compiled by Numba.

The first call on a machine compiles (seconds) and caches the result beside the source, in
`__pycache__`; later calls load it. Compiled functions take arrays and numbers, no objects. They
release the interpreter's lock, so that stages can run them in threads, and are compiled without
fast-math and for a single thread, so that the same input gives the same bytes.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

Function = TypeVar("Function", bound=Callable[..., object])


def compiled(function: Function) -> Function:
    """Compile a function with Numba, at its first call for each set of argument types.

    Division by zero gives infinity or NaN, as in numpy. The cache on disk is valid as long as the
    function's file, and the files it imports compiled functions from, are unchanged. Inside,
    int() of a uint8 is unsigned and differences of such wrap round: write float() or np.int64().
    Copy arrays in a loop: `a[i] = b` also compiles the text of its error, two seconds a process.
    """
    options = {"nogil": True, "error_model": "numpy"}
    try:
        kept = numba.njit(cache=True, **options)(function)
        _look_at_imports(kept, function)
    except (RuntimeError, AttributeError):
        # Nowhere to cache, or a Numba whose cache works differently.
        return cast(Function, numba.njit(**options)(function))
    return cast(Function, kept)


def _look_at_imports(kept: Any, function: Any) -> None:
    """Make the cache depend on the files of called functions too: Numba checks the function's own
    alone, and would keep using stale versions of those that it calls."""
    source_file = function.__code__.co_filename
    called = {
        value.py_func.__code__.co_filename
        for value in function.__globals__.values()
        if isinstance(value, type(kept))
    }
    files = kept._cache._cache_file
    stats = [(file, os.stat(file)) for file in sorted(called - {source_file})]
    stamps = [(file, stat.st_mtime, stat.st_size) for file, stat in stats]
    files._source_stamp = (*files._source_stamp, *stamps)
