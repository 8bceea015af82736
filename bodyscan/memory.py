"""How a process of ours treats memory: freed blocks are kept, garbage is sought seldom."""

from __future__ import annotations

import ctypes
import gc
import sys

TRIM_THRESHOLD, MMAP_MAX, ARENA_MAX = -1, -4, -8  # from glibc's malloc.h
NEVER = 2**31 - 1
SELDOM = 50_000
"""Objects, net, made between two searches for cycles; Python's 700 cost a cold scan 0.06 s."""


def collect_seldom() -> None:
    """Search for cyclic garbage less often: what is large are arrays, freed by counting alone."""
    gc.set_threshold(SELDOM)


def keep_freed_memory() -> None:
    """Tell the C library to keep freed blocks. Call it before the process starts any thread.

    On most Linux systems the C library returns large blocks to the kernel when they are freed, and
    the kernel clears them again, page by page, for the next image. Other systems are left alone.
    """
    if not sys.platform.startswith("linux"):
        return
    set_option = getattr(ctypes.CDLL(None), "mallopt", None)
    if set_option is not None:
        set_option(TRIM_THRESHOLD, NEVER)
        set_option(MMAP_MAX, 0)
        set_option(ARENA_MAX, 1)  # otherwise each thread keeps memory of its own
