"""Files written completely or not at all, with the same bytes for the same content; locks."""

from __future__ import annotations

import json
import os
import secrets
import shutil
import stat
import tempfile
import time
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from glob import escape
from pathlib import Path
from typing import Any

from bodyscan.errors import BadInput


@contextmanager
def atomic_replacement(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`, which replaces `path` if the block succeeds.

    The temporary path keeps the suffix, because writers such as Open3D's choose the format by it.
    If the block raises, the temporary file is removed and `path` is left as it was. The folder is
    created if necessary. A block that writes nothing raises FileNotFoundError. What killed writers of
    `path` left is removed once it is an hour old: no living one takes as long.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    sweep_temporary(path.parent, escape(path.stem), older_s=3600.0)
    temporary = path.with_name(f".{path.stem}.{secrets.token_hex(6)}.tmp{path.suffix}")
    try:
        yield temporary
        flush(temporary, os.O_RDWR)
        os.replace(temporary, path)
    except BaseException as error:
        with suppress(OSError):
            temporary.unlink()
        if isinstance(error, OSError) and error.filename in (None, str(temporary)) and error.errno:
            raise OSError(error.errno, error.strerror, str(path)) from error  # the known name
        raise
    if os.name == "posix":  # the rename itself must survive a power cut too
        flush(path.parent)


def write_bytes(path: Path, data: bytes) -> None:
    """Write `data` to `path`, all or nothing."""
    with atomic_replacement(path) as temporary:
        temporary.write_bytes(data)


def write_text(path: Path, text: str) -> None:
    """Write `text` to `path` as UTF-8 with plain line feeds, all or nothing."""
    write_bytes(path, text.encode("utf-8"))


def write_json(path: Path, content: Any) -> None:
    """Write `format_json(content)` to `path`, all or nothing."""
    write_text(path, format_json(content))


def format_json(content: Any) -> str:
    """Format as JSON that is exact when read back (float64 to the last bit) and easy to diff.

    Keys are sorted, indents are two spaces, a list of numbers takes one line (so a matrix takes one
    line per row). numpy arrays and scalars are written as lists and numbers. Raises ValueError for
    NaN and infinity, which JSON does not have, and TypeError for what JSON cannot hold.
    """
    return _format_value(content, "") + "\n"


def write_npz(path: Path, /, **arrays: Any) -> None:
    """Write arrays as a compressed .npz whose bytes depend only on the arrays (no time stamps).

    Read back with `numpy.load(path, allow_pickle=False)`. Raises ValueError for object arrays.
    """
    import numpy as np

    with atomic_replacement(path) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        for name in sorted(arrays):
            entry = zipfile.ZipInfo(f"{name}.npy")  # of 1980: any fixed time would do
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.external_attr = 0o644 << 16
            entry.create_system = 3
            with archive.open(entry, "w", force_zip64=True) as stream:
                np.lib.format.write_array(stream, np.asanyarray(arrays[name]), allow_pickle=False)


def flush(path: Path, flags: int = os.O_RDONLY) -> None:
    """Flush a file, or the names in a folder, to the disk itself."""
    handle = os.open(path, flags)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _format_value(value: Any, indent: str) -> str:
    value = value.tolist() if hasattr(value, "tolist") else value
    deeper = indent + "  "
    if isinstance(value, Mapping) and value:
        if not all(isinstance(key, str) for key in value):
            raise TypeError(f"JSON keys must be text, got {list(value)[:5]}")
        items = [f"{json.dumps(key)}: {_format_value(value[key], deeper)}" for key in sorted(value)]
        brackets = "{}"
    elif isinstance(value, list | tuple) and any(
        isinstance(item, Mapping | list | tuple) or getattr(item, "ndim", 0) > 0 for item in value
    ):
        items = [_format_value(item, deeper) for item in value]
        brackets = "[]"
    elif isinstance(value, list | tuple):
        return "[" + ", ".join(_format_value(item, deeper) for item in value) + "]"
    else:
        return json.dumps({} if isinstance(value, Mapping) else value, allow_nan=False)
    inside = f",\n{deeper}".join(items)
    return f"{brackets[0]}\n{deeper}{inside}\n{indent}{brackets[1]}"


@contextmanager
def lock_file(path: Path, *, wait: bool) -> Iterator[None]:
    """Hold the lock on `path` (flock: the kernel releases it, even after `kill -9`).

    wait: wait for the present holder; otherwise raise BadInput, which names the holder.
    """
    import fcntl  # POSIX only

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
                f"another batch is running here ({holder})",
                where=str(path.parent),
                remedy="wait until it has ended, or give another --out",
            ) from None
        with suppress(OSError):  # good to know who holds it, but a full disk is no obstacle
            os.ftruncate(handle, 0)
            since = time.strftime("%Y-%m-%d %H:%M:%S")
            os.pwrite(handle, f"process {os.getpid()} since {since}\n".encode(), 0)
        yield
    finally:
        os.close(handle)


@contextmanager
def hold_folder(folder: Path) -> Iterator[None]:
    """Hold a folder of results, made if it is not there, for this process alone, and remove what killed
    ones left half written in it.

    Raises BadInput if another process holds it: the last to end would replace what the first wrote.
    The folder itself is locked (flock: nothing is left behind, even after `kill -9`); where a file
    system cannot, nothing is held or removed.
    """
    is_new = not folder.exists()
    folder.mkdir(parents=True, exist_ok=True)
    handle = None
    try:
        with suppress(ImportError, OSError):
            import fcntl  # POSIX only

            handle = os.open(folder, os.O_RDONLY)
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise BadInput(
                    "another command is writing here",
                    where=str(folder),
                    remedy="wait until it has ended, or give another --out",
                ) from None
            sweep_temporary(folder)
        yield
    finally:
        if handle is not None:
            os.close(handle)
        if is_new:
            with suppress(OSError):  # not empty
                folder.rmdir()


def sweep_temporary(folder: Path, stem: str = "*", *, older_s: float = 0.0) -> None:
    """Remove what killed writers left half written in a folder: of one file, or all."""
    for path in folder.glob(f".{stem}.{'[0-9a-f]' * 12}.tmp*"):
        with suppress(OSError):
            if not older_s or time.time() - path.stat().st_mtime > older_s:
                path.unlink()


@contextmanager
def scratch_folder() -> Iterator[Path]:
    """Make a folder for images of people below the system's temporary one (TMPDIR), and remove it
    at the end; first remove what killed processes of this user left there."""
    sweep_scratch()
    folder = Path(tempfile.mkdtemp(prefix="bodyscan-scratch-"))
    try:
        with lock_file(folder / "lock", wait=True):
            yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def sweep_scratch(*, with_own: bool = False) -> None:
    """Remove scratch folders of this user that no process holds; with_own: and those of this one."""
    for folder in Path(tempfile.gettempdir()).glob("bodyscan-scratch-*"):
        with suppress(OSError, BadInput):
            found = folder.lstat()
            if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid():
                continue
            holder = folder / "lock"
            held_by = holder.read_text("utf-8") if holder.exists() else ""
            if not (with_own and f"process {os.getpid()} " in held_by):
                if not held_by and time.time() - found.st_mtime < 60.0:
                    continue  # perhaps not locked yet
                with lock_file(holder, wait=False):
                    pass
            shutil.rmtree(folder)


@contextmanager
def restrict_to_owner() -> Iterator[None]:
    """Make files created inside readable only by their owner (0600), folders too (0700)."""
    before = os.umask(0o077)
    try:
        yield
    finally:
        os.umask(before)
