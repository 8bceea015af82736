"""What files and settings are, by SHA-256 of their content: names, times and places do not count."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from bodyscan.files.regular import open_regular
from bodyscan.progress import threaded

_BLOCK = 1 << 20


def file_hash(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal.

    Raises BadInput for what is not a regular file (a pipe would be waited on for ever), OSError when it
    cannot be read.
    """
    with open_regular(path) as stream:
        digest = hashlib.sha256()
        while block := stream.read(_BLOCK):
            digest.update(block)
    return digest.hexdigest()


def file_hashes(files: Mapping[str, Path]) -> dict[str, str]:
    """Name -> SHA-256 of each file, sorted by name."""
    names = sorted(files)
    hashes = threaded(lambda name: file_hash(files[name]), names, stage="hashing")
    return dict(zip(names, hashes, strict=True))


def files_below(folder: Path) -> Iterator[Path]:
    """Every file below `folder` in a fixed order; symbolic links are named, never followed."""
    for root, folders, files in os.walk(folder):
        links = [name for name in folders if os.path.islink(os.path.join(root, name))]
        folders[:] = sorted(set(folders) - set(links))
        yield from (Path(root, name) for name in sorted([*files, *links]))


def content_hash(content: Any) -> str:
    """SHA-256 of plain data, by its JSON with sorted keys."""
    text = json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode("ascii")).hexdigest()
