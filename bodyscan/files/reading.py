"""Files that anyone may have made, read within limits: plain bytes, JSON, arrays.

Files are opened only if they are regular: reading a pipe or a device might never end.
"""

from __future__ import annotations

import errno
import io
import json
import lzma
import math
import os
import stat
import struct
import tokenize
import zipfile
import zlib
from pathlib import Path
from typing import Any, BinaryIO

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
    raise BadInput("is not a regular file", where=str(path), remedy="remove it")


def read_regular(path: Path, max_bytes: int | None = None) -> bytes:
    """Read a whole file. Raises as `open_regular`, and OSError if it is longer than `max_bytes`."""
    with open_regular(path) as stream:
        if max_bytes is not None and os.fstat(stream.fileno()).st_size > max_bytes:
            raise OSError(errno.EOVERFLOW, f"is longer than {max_bytes:,} bytes", str(path))
        return stream.read()


def read_json_object(path: Path) -> dict[str, Any]:
    """Read the single mapping in a JSON file, with every number finite.

    Raises ValueError for anything else (duplicate keys, NaN, 1e999, half surrogates, nested too
    deeply), BadInput if it is not a regular file, OSError if it cannot be read or is too long.
    """
    # A calibration of sixteen pairs and two hundred shots takes a million bytes.
    data = read_regular(path, 100_000_000)
    try:
        content = json.loads(
            data.decode("utf-8"),
            parse_float=_parse_finite,
            parse_int=lambda text: int(text) if len(text) < 300 else _parse_finite(text),
            parse_constant=_parse_finite,
            object_pairs_hook=_refuse_duplicate_keys,
        )
    except RecursionError:
        raise ValueError("is nested too deep") from None
    if b"\\ud" in data.lower():
        # Half of a surrogate pair could be read, but never printed or written again.
        json.dumps(content, ensure_ascii=False).encode("utf-8")
    if not isinstance(content, dict):
        raise ValueError("does not hold a mapping")
    return content


def read_npz(path: Path, max_bytes: int = 1 << 28) -> dict[str, Any]:
    """Read the arrays of an .npz by name.

    max_bytes: of all arrays, checked before anything is unpacked; those of sixteen pairs take a
        fiftieth of it.

    Raises ValueError for what is damaged, too large, or not a plain array (nothing is ever
    unpickled), BadInput if the file is not a regular one, OSError if it cannot be read.
    """
    with open_regular(path) as stream:
        try:
            with zipfile.ZipFile(stream) as archive:
                entries = archive.infolist()
                size = sum(entry.file_size for entry in entries)
                if size > max_bytes:
                    raise ValueError(f"unpacks to {size:,} bytes, more than {max_bytes:,}")
                return {
                    entry.filename.removesuffix(".npy"): _read_array(archive, entry)
                    for entry in entries
                }
        except (
            zipfile.BadZipFile, zlib.error, lzma.LZMAError, struct.error, EOFError, OverflowError,
            tokenize.TokenError, SyntaxError, TypeError, KeyError, AttributeError, MemoryError,
        ) as error:  # fmt: skip
            raise ValueError(f"is damaged ({error})") from error
        except (NotImplementedError, RuntimeError) as error:  # compressed otherwise, encrypted
            raise ValueError(f"is not an archive of arrays ({error})") from error


def _read_array(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> Any:
    import numpy.lib.format as npy  # here: `check` does without numpy

    with archive.open(entry) as packed:
        data = packed.read(entry.file_size)
    stream = io.BytesIO(data)
    version = npy.read_magic(stream)
    headers = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
    if version not in headers:
        raise ValueError(f"{entry.filename} is an array file of version {version}")
    shape, _, kind = headers[version](stream)
    count = math.prod(map(int, shape))  # in integers of any size: a shape may lie
    if kind.hasobject or count * kind.itemsize != len(data) - stream.tell():
        raise ValueError(f"{entry.filename} has a header that does not fit its content")
    stream.seek(0)
    return npy.read_array(stream, allow_pickle=False)


def _parse_finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text} is not a finite number")
    return value


def _refuse_duplicate_keys(items: list[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(items)
    if len(content) < len(items):
        names = [name for name, _ in items]
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"{twice!r} is given twice in the same place")
    return content
