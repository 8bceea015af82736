"""Memory of a process: keep freed blocks, collect cyclic garbage seldom, reserve what BLAS needs."""

from __future__ import annotations

import ctypes
import gc
import sys
import threading
from pathlib import Path


def collect_seldom() -> None:
    """Search for cyclic garbage less often: what is large are arrays, freed by counting alone."""
    gc.set_threshold(50_000)  # Python's 700 cost a cold scan 0.06 s


def keep_freed_memory() -> None:
    """Tell the C library to keep freed blocks. Call it before the process starts any thread.

    On most Linux systems the C library returns large blocks to the kernel when they are freed, and
    the kernel clears them again, page by page, for the next image. Other systems are left alone.
    """
    if not sys.platform.startswith("linux"):
        return
    set_option = getattr(ctypes.CDLL(None), "mallopt", None)
    if set_option is not None:
        trim_threshold, mmap_max, arena_max = -1, -4, -8  # from glibc's malloc.h
        set_option(trim_threshold, 2**31 - 1)
        set_option(mmap_max, 0)
        set_option(arena_max, 1)  # otherwise each thread keeps memory of its own


def reserve_blas_memory(threads: int) -> None:
    """Let scipy's BLAS allocate its buffers now, if this process's address space is limited.

    Its OpenBLAS (0.3.30) allocates 34 MB at the first call of each thread, and tries for ever if it
    gets none: a scan would hang. Raises MemoryError if there is not even room for that.
    """
    try:
        import resource
    except ImportError:  # not on Windows, which has no such limit
        return
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit == resource.RLIM_INFINITY or not sys.platform.startswith("linux"):
        return
    import numpy as np
    from scipy.linalg.blas import dgemm

    in_use = int(Path("/proc/self/statm").read_text("ascii").split()[0]) * resource.getpagesize()
    if limit - in_use < threads * 60e6:
        raise MemoryError(f"the address space is limited to {limit / 1e6:.0f} MB")
    # At the same moment, so that each thread finds the others' buffers taken.
    ready = threading.Barrier(threads)

    def multiply() -> None:
        square = np.ones((500, 500), order="F")
        ready.wait(timeout=60.0)
        dgemm(1.0, square, square)

    every = [threading.Thread(target=multiply) for _ in range(threads)]
    for thread in every:
        thread.start()
    for thread in every:
        thread.join()
