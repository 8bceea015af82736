"""Identity of files and settings: SHA-256 of their content, whatever their names and times."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from bodyscan.files.reading import open_regular
from bodyscan.progress import map_threads


def hash_file(path: Path) -> str:
    """Compute the SHA-256 of a file, in hexadecimal.

    Raises BadInput if it is not a regular file (reading a pipe might never end), OSError if it
    cannot be read.
    """
    with open_regular(path) as stream:
        digest = hashlib.sha256()
        while block := stream.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def hash_files(files: Mapping[str, Path]) -> dict[str, str]:
    """Compute the SHA-256 of each file by name, sorted by name."""
    names = sorted(files)
    hashes = map_threads(lambda name: hash_file(files[name]), names)
    return dict(zip(names, hashes, strict=True))


def list_files(folder: Path) -> Iterator[Path]:
    """List every file below `folder` in a fixed order; symbolic links are listed, never followed."""
    for root, folders, files in os.walk(folder):
        links = [name for name in folders if os.path.islink(os.path.join(root, name))]
        folders[:] = sorted(set(folders) - set(links))
        yield from (Path(root, name) for name in sorted([*files, *links]))


def list_relative_files(folder: Path) -> dict[str, Path]:
    """List every file below `folder` by its path relative to it."""
    return {path.relative_to(folder).as_posix(): path for path in list_files(folder)}


def hash_content(content: Any) -> str:
    """Compute the SHA-256 of plain data, by its JSON with sorted keys."""
    text = json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode("ascii")).hexdigest()
