"""Loops over pixels that numpy would need many passes for, compiled by Numba.

The first call on a machine compiles (seconds) and leaves the result beside the source, in
`__pycache__`; from then on it is loaded. Compiled functions take arrays and numbers, no objects;
they release the interpreter's lock, so stages run them in threads, and they are compiled without
fast-math and for one thread: the same input gives the same bytes.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar, cast

import numba

Function = TypeVar("Function", bound=Callable[..., object])


def compiled(function: Function) -> Function:
    """The function, compiled at its first call for the types it is given.

    Division by zero gives infinity or NaN, as in numpy. Numba looks at a file's date to see whether
    what it kept is still good, and not at the functions called from other files: compiled functions
    call only those of their own file. int() of a uint8 is unsigned there, and differences of such
    wrap round: write float(), or np.int64().
    """
    options = {"nogil": True, "error_model": "numpy"}
    try:
        return cast(Function, numba.njit(cache=True, **options)(function))
    except RuntimeError:  # neither beside the source nor in the user's cache can files be kept
        return cast(Function, numba.njit(**options)(function))
