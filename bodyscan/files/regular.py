"""Files opened only if they are files: a pipe or a device would be waited on for ever."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path
from typing import BinaryIO

from bodyscan.errors import BadInput


def open_regular(path: Path) -> BinaryIO:
    """A file for reading, as bytes.

    Raises BadInput for what is there and no regular file, OSError when it cannot be opened.
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
    """All of a file; of a longer one `most_bytes` + 1. Raises as `open_regular`."""
    with open_regular(path) as stream:
        return stream.read(-1 if most_bytes is None else most_bytes + 1)
