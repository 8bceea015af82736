"""Arrays read from an .npz that anyone may have made, within a limit of memory."""

from __future__ import annotations

import io
import lzma
import struct
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from bodyscan.files.regular import open_regular

MOST_BYTES = 1 << 28  # of all arrays unpacked; those of sixteen pairs take a fiftieth of it
_DAMAGE = (zipfile.BadZipFile, zlib.error, lzma.LZMAError, struct.error, EOFError, OverflowError)
_STRANGE = (NotImplementedError, RuntimeError)  # an unsupported compression, an encrypted archive


def read_npz(path: Path, most_bytes: int = MOST_BYTES) -> dict[str, Any]:
    """Arrays by name. The sizes that the archive states are checked before anything is unpacked.

    Raises ValueError for what is damaged, too large, or not a plain array (nothing is ever
    unpickled), BadInput if the file is not a regular one, OSError if it cannot be read.
    """
    with open_regular(path) as stream:
        try:
            with zipfile.ZipFile(stream) as archive:
                entries = archive.infolist()
                size = sum(entry.file_size for entry in entries)
                if size > most_bytes:
                    raise ValueError(f"unpacks to {size:,} bytes, more than {most_bytes:,}")
                return {
                    entry.filename.removesuffix(".npy"): _array(archive, entry) for entry in entries
                }
        except _DAMAGE as error:
            raise ValueError(f"is damaged ({error})") from error
        except _STRANGE as error:
            raise ValueError(f"is not an archive of arrays ({error})") from error


def _array(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> Any:
    with archive.open(entry) as packed:
        data = packed.read(entry.file_size)
    stream = io.BytesIO(data)
    version = np.lib.format.read_magic(stream)
    header = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }
    if version not in header:
        raise ValueError(f"{entry.filename} is an array file of version {version}")
    shape, _, kind = header[version](stream)
    count = 1
    for length in shape:  # as Python integers of any size: a shape may lie
        count *= length
    if kind.hasobject or count * kind.itemsize != len(data) - stream.tell():
        raise ValueError(f"{entry.filename} does not hold what it says")
    stream.seek(0)
    return np.lib.format.read_array(stream, allow_pickle=False)
