"""Errors of the operating system in words, in one place for every command and job."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from tempfile import TemporaryFile

from bodyscan.errors import BadInput, BodyscanError, FailedWork

FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
FORBIDDEN = (errno.EACCES, errno.EPERM, errno.EROFS)
ABSENT = (errno.ENOENT, errno.ENOTDIR, errno.EISDIR, errno.ENAMETOOLONG, errno.ELOOP)
PROBE = bytes(65536)  # room for at least this: less than any result takes, and written in no time


def in_words(error: OSError) -> BodyscanError:
    """BadInput if another file or folder would do, FailedWork if the machine has to change."""
    where = "" if error.filename is None else os.fsdecode(error.filename)
    said = error.strerror or str(error)
    if error.errno in FULL:
        return FailedWork(
            f"the disk is full ({said})", where=where, remedy="make room, then start again"
        )
    if error.errno in FORBIDDEN:
        remedy = "give it the right permissions, or name another place"
        return BadInput(f"is not allowed here ({said})", where=where, remedy=remedy)
    if error.errno in ABSENT:
        return BadInput(said, where=where, remedy="name what is there")
    if error.errno == errno.EPIPE:
        return FailedWork("whoever read the output has closed it")
    return FailedWork(
        said, where=where, remedy="look after the disk or the network, then start again"
    )


def require_writable(folder: Path) -> None:
    """Raise BadInput or FailedWork if nothing can be written into `folder`, which need not exist.

    It is tested before the work, not after: by writing to the nearest existing folder above.
    """
    if folder.exists() and not folder.is_dir():
        raise BadInput(
            "is a file; results go into a folder", where=str(folder), remedy="give another --out"
        )
    place = folder.absolute()
    try:
        while not place.is_dir():
            place = place.parent
        with TemporaryFile(dir=place) as probe:
            probe.write(PROBE)
            probe.flush()
    except OSError as error:
        raise in_words(OSError(error.errno, error.strerror, str(folder))) from error
