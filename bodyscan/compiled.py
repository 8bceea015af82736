"""Loops over pixels that numpy would need many passes for, compiled by Numba.

The first call on a machine compiles (seconds) and leaves the result beside the source, in
`__pycache__`; from then on it is loaded. Compiled functions take arrays and numbers, no objects;
they release the interpreter's lock, so stages run them in threads, and they are compiled without
fast-math and for one thread: the same input gives the same bytes.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

Function = TypeVar("Function", bound=Callable[..., object])


def compiled(function: Function) -> Function:
    """The function, compiled at its first call for the types it is given.

    Division by zero gives infinity or NaN, as in numpy. What was kept on disk is good as long as the
    function's file and those that it imports compiled functions from are unchanged. int() of a
    uint8 is unsigned there, and differences of such wrap round: write float(), or np.int64().
    Copy arrays in a loop: `a[i] = b` compiles the words of its error as well, two seconds a process.
    """
    options = {"nogil": True, "error_model": "numpy"}
    try:
        kept = numba.njit(cache=True, **options)(function)
        _look_at_imports(kept, function)
    except (
        RuntimeError,
        AttributeError,
    ):  # no place for files, or a Numba that keeps them otherwise
        return cast(Function, numba.njit(**options)(function))
    return cast(Function, kept)


def _look_at_imports(kept: Any, function: Any) -> None:
    """Numba looks at the date and size of the function's own file alone: it would go on with what
    called functions were before their files changed."""
    own = function.__code__.co_filename
    called = {
        value.py_func.__code__.co_filename
        for value in function.__globals__.values()
        if isinstance(value, type(kept))
    }
    files = kept._cache._cache_file
    stamps = [
        (file, os.stat(file).st_mtime, os.stat(file).st_size) for file in sorted(called - {own})
    ]
    files._source_stamp = (*files._source_stamp, *stamps)
