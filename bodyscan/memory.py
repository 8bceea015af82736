"""Keep memory that one image has freed, for the next one."""

from __future__ import annotations

import ctypes
import sys

TRIM_THRESHOLD, MMAP_MAX, ARENA_MAX = -1, -4, -8  # from glibc's malloc.h
NEVER = 2**31 - 1


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
