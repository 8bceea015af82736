"""A lock that ends with its process, however that ends; and files only their owner can read."""

from __future__ import annotations

import fcntl
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from bodyscan.errors import BadInput


@contextmanager
def file_lock(path: Path, *, wait: bool) -> Iterator[None]:
    """Hold the lock on `path` (flock: the kernel releases it, even after `kill -9`).

    wait: wait for the present holder; otherwise raise BadInput, which names the holder.
    """
    try:
        handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o600)
    except OSError as error:
        raise BadInput(f"cannot be written: {error.strerror}", where=str(path)) from error
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except BlockingIOError:
            holder = os.pread(handle, 200, 0).decode("utf-8", "replace").strip() or "someone"
            raise BadInput(
                f"another batch is at work here ({holder})",
                where=str(path.parent),
                remedy="wait until it has ended, or give another --out",
            ) from None
        with suppress(OSError):  # good to know who holds it, but a full disk is no obstacle
            os.ftruncate(handle, 0)
            os.pwrite(handle, f"process {os.getpid()} on {socket.gethostname()}\n".encode(), 0)
        yield
    finally:
        os.close(handle)


@contextmanager
def for_owner_only() -> Iterator[None]:
    """Make files created inside readable only by their owner (0600), folders too (0700)."""
    before = os.umask(0o077)
    try:
        yield
    finally:
        os.umask(before)
