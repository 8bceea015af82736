"""Messages about files: errors of the operating system in plain words, paths made relative."""

from __future__ import annotations

import errno
import os
import re
import unicodedata
from collections.abc import Iterable
from pathlib import Path
from tempfile import TemporaryFile

from bodyscan.errors import BadInput, BodyscanError, FailedWork


def translate_os_error(error: OSError) -> BodyscanError:
    """Convert to BadInput if another file or folder would do, else to FailedWork."""
    where = "" if error.filename is None else os.fsdecode(error.filename)
    what = error.strerror or str(error)
    if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        remedy = "make room, then start again"
        return FailedWork(f"the disk is full ({what})", where=where, remedy=remedy)
    if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
        remedy = "give it the right permissions, or name another path"
        return BadInput(f"is not allowed here ({what})", where=where, remedy=remedy)
    if error.errno in (
        errno.ENOENT, errno.ENOTDIR, errno.EISDIR, errno.ENAMETOOLONG, errno.ELOOP
    ):  # fmt: skip
        return BadInput(what, where=where, remedy="name one that exists")
    if error.errno == errno.EPIPE:
        return FailedWork("the program that read the output has closed it")
    return FailedWork(what, where=where, remedy="check the disk or the network, then start again")


def translate_failure(error: Exception) -> BodyscanError | None:
    """Convert what the system refuses (files, memory, threads, libraries) to FailedWork or BadInput;
    None for any other error, which is a mistake of ours."""
    text = str(error)
    if isinstance(error, ImportError | OSError):
        missing = re.search(r"\blib[\w.+-]+\.so[\w.]*(?=: cannot open shared object)", text)
        if missing:
            return FailedWork(
                f"the system library {missing[0]} is missing, which Open3D or pycolmap needs",
                remedy="on Debian or Ubuntu: apt-get install libegl1 libgl1 libgomp1 libidn2-0 "
                "libusb-1.0-0 libx11-6",
            )
    if isinstance(error, ModuleNotFoundError) and not (error.name or "bodyscan").startswith(
        "bodyscan"
    ):
        remedy = "install bodyscan again, with everything that it asks for"
        if error.name in ("open3d", "pycolmap"):
            remedy = f"pip install {error.name} (bodyscan-core comes without it)"
        return FailedWork(f"the Python package {error.name} is missing", remedy=remedy)
    if isinstance(error, OSError):
        return translate_os_error(error)
    short = ("can't start new thread", "failed to map segment", "Cannot allocate memory")
    if isinstance(error, MemoryError) or any(words in text for words in short):
        remedy = "close other programs, raise the limit (`ulimit -v`), or ask for less"
        return FailedWork("there is not enough memory", where=text, remedy=remedy)
    return None


def require_suffix(path: Path, suffixes: Iterable[str], what: str) -> None:
    """Raise BadInput if `what` is not written to files with the path's suffix: another kind of file,
    such as captures.yaml, is never replaced by it."""
    if path.suffix.lower() not in suffixes:
        written = f"{what} cannot be written as {path.suffix!r}"
        raise BadInput(written, where=str(path), remedy=f"choose from {', '.join(suffixes)}")


def require_writable(folder: Path, *inputs: Path | None) -> None:
    """Raise BadInput or FailedWork if nothing can, or may, be written into `folder`, there or not.

    inputs: folders of images and calibrations that the work reads (of a file, its folder): `folder`
        is none of them, lies in none and holds none. None is no input.

    It is tested before the work, not after: by writing to the nearest existing folder above.
    """
    out = folder.resolve()
    for path in filter(None, inputs):
        read = (path.parent if path.is_file() else path).resolve()
        if out == read or read in out.parents or out in read.parents:
            how = "is" if out == read else "lies inside" if read in out.parents else "contains"
            raise BadInput(
                f"{how} {path}, which is read: results would be taken for input, or replace it",
                where=str(folder),
                remedy="give --out (or --repair) a folder beside what is read",
            )
    if folder.exists() and not folder.is_dir():
        raise BadInput(
            "is a file; results go into a folder", where=str(folder), remedy="give another --out"
        )
    parent = folder.absolute()
    try:
        while not parent.is_dir():
            parent = parent.parent
        with TemporaryFile(dir=parent) as probe:
            probe.write(bytes(65536))  # less than any result takes, and written in no time
            probe.flush()
    except OSError as error:
        raise translate_os_error(OSError(error.errno, error.strerror, str(folder))) from error


def describe_similar_shots(shots: Iterable[tuple[str, str]]) -> str:
    """Describe two shots, of (pair, shot), whose names differ only in how they are written, or ""."""
    written: dict[str, tuple[str, str]] = {}
    for pair, shot in sorted(set(shots)):
        name = unicodedata.normalize("NFC", shot).casefold()
        other, first = written.setdefault(re.sub(r"(?<!\d)0+(?=\d)", "", name), (pair, shot))
        if first != shot and other != pair:
            both = f"{first!a} ({other}) and {shot!a} ({pair})"
            return f"shots {both} differ only in zeros, capitals or accents: give both one name"
    return ""


def make_paths_relative(text: str, base: Path, below: Iterable[Path] = ()) -> str:
    """Make every path in `text` that begins with `base`, or a folder of `below`, relative to `base`.

    For stored messages: folders are named after people, and the same work in another folder must
    give the same bytes.
    """
    for folder in (*below, base):
        short = os.path.relpath(folder, base)
        to = "" if short == os.curdir else f"{Path(short).as_posix()}/"
        for known in {str(folder), os.path.abspath(folder)} - {os.curdir}:
            # Not in the middle of another path.
            pattern = rf"(?<![\w./-]){re.escape(known.rstrip('/'))}/"
            text = re.sub(pattern, to.replace("\\", "/"), text)
    return text
