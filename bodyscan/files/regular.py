"""Files opened only if they are regular: reading a pipe or a device might never end."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path
from typing import BinaryIO

from bodyscan.errors import BadInput


def open_regular(path: Path) -> BinaryIO:
    """Open a file for reading bytes.

    Raises BadInput if it exists but is not a regular file, OSError if it cannot be opened.
    """
    handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0))
    mode = os.fstat(handle).st_mode
    if stat.S_ISREG(mode):
        return os.fdopen(handle, "rb")
    os.close(handle)
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    raise BadInput("is not a regular file", where=str(path), remedy="take it away")


def read_regular(path: Path, most_bytes: int | None = None) -> bytes:
    """The whole file; of a longer one, `most_bytes` + 1. Raises as `open_regular`."""
    with open_regular(path) as stream:
        return stream.read(-1 if most_bytes is None else most_bytes + 1)
