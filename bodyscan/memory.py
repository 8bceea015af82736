"""Memory that one image has freed is used for the next one."""

from __future__ import annotations

import ctypes
import sys

TRIM_THRESHOLD, MMAP_MAX, ARENA_MAX = -1, -4, -8  # of glibc's malloc.h
NEVER = 2**31 - 1


def keep_freed_memory() -> None:
    """For processes of ours, before they start threads.

    The C library of most Linuxes hands large blocks back to the kernel once they are freed, and
    the kernel clears them, page by page, when the next image wants as much. Other systems'
    libraries are left as they are.
    """
    if not sys.platform.startswith("linux"):
        return
    set_option = getattr(ctypes.CDLL(None), "mallopt", None)
    if set_option is not None:
        set_option(TRIM_THRESHOLD, NEVER)
        set_option(MMAP_MAX, 0)
        set_option(ARENA_MAX, 1)  # threads would keep memory of their own
