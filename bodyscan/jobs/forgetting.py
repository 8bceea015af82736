"""Every file of a subject in a workspace, found by the files' content and never by their names.

A folder is a subject's if its captures.yaml, scan.json or job.json says so, together with
everything below it that is not another subject's. Elsewhere an export is recognised by the JSON
beside it. Rows of summaries and entries of manifests about the subject are removed too.
"""

from __future__ import annotations

import csv
import io
import json
import os
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bodyscan.captures.captures_file import FILE_NAME as CAPTURES
from bodyscan.errors import BadInput
from bodyscan.files.atomic import lock_file, restrict_to_owner, write_text
from bodyscan.files.yaml_file import YamlError, read_yaml
from bodyscan.jobs.job import BATCH_LOCK, JOB, MANIFEST, SUMMARY
from bodyscan.jobs.summary import write_out_manifest

# Removed in this order, so that the file which names the owner goes last: an interrupted removal
# can be continued.
_MARKERS = ("scan.json", JOB, CAPTURES)


@dataclass(frozen=True)
class SubjectFiles:
    """What belongs to a subject.

    files: of the subject.
    folders: of the subject alone.
    tables: folders of batches, whose manifests are rewritten.
    rows: those of them whose summary has rows of the subject.
    unreadable: files that should name a folder's owner, and do not.
    """

    files: tuple[Path, ...]
    folders: tuple[Path, ...]
    tables: tuple[Path, ...]
    rows: tuple[Path, ...]
    unreadable: tuple[Path, ...]


def find_subject(subject: str, workspace: Path) -> SubjectFiles:
    """Find what `forget_subject` would remove. Raises BadInput if the workspace is not a folder."""
    if not workspace.is_dir():
        raise BadInput("there is no such folder", where=str(workspace), remedy="check --workspace")
    lists: list[list[Path]] = [[], [], [], []]
    files, folders, tables, unreadable = lists
    for folder, names, owner in _walk(workspace, None, unreadable):
        found = set(names) if owner == subject else _exports(folder, names, subject)
        files += (folder / name for name in found)
        if owner == subject and folder != workspace:
            folders.append(folder)
        if BATCH_LOCK in names and owner is None:
            tables.append(folder)
    order = {name: rank for rank, name in enumerate(_MARKERS, start=1)}
    files.sort(key=lambda path: (order.get(path.name, 0), path))
    rows = [out for out in tables if _without(subject, out / SUMMARY) is not None]
    return SubjectFiles(tuple(files), tuple(folders), tuple(tables), tuple(rows), tuple(unreadable))


def forget_subject(subject: str, workspace: Path) -> SubjectFiles:
    """Remove every file of a subject in a workspace; links are removed, never followed.

    Raises BadInput if there is nothing of that subject, or a batch is working in the workspace.
    """
    with ExitStack() as locks:
        locks.enter_context(restrict_to_owner())
        found = find_subject(subject, workspace)
        for out in found.tables:
            locks.enter_context(lock_file(out / BATCH_LOCK, wait=False))
        if not found.files and not found.rows:
            raise BadInput(
                f"holds nothing of subject {subject!r}",
                where=str(workspace),
                remedy="give the pseudonym as captures.yaml has it, and the --workspace",
            )
        for out in found.rows:
            write_text(out / SUMMARY, _without(subject, out / SUMMARY) or "")
        for path in found.files:
            path.unlink(missing_ok=True)
        for folder in sorted(found.folders, reverse=True):
            with suppress(OSError):  # it holds something of another subject
                folder.rmdir()
        for out in found.tables:
            if (out / MANIFEST).exists():
                write_out_manifest(out)
    return found


def _walk(
    folder: Path, owner: str | None, unreadable: list[Path]
) -> Iterator[tuple[Path, list[str], str | None]]:
    """Every folder with the names of its files (and links), and its owner."""
    with os.scandir(folder) as entries:
        listed = sorted(entries, key=lambda entry: entry.name)
    names = [entry.name for entry in listed if not entry.is_dir(follow_symlinks=False)]
    for marker in _MARKERS:
        if marker in names:
            try:
                owner = _subject(folder / marker) or owner
            except (OSError, ValueError, YamlError, RecursionError):
                unreadable.append(folder / marker)
    yield folder, names, owner
    for entry in listed:
        if entry.is_dir(follow_symlinks=False):
            yield from _walk(Path(entry.path), owner, unreadable)


def _subject(path: Path) -> str | None:
    """The subject that a file names as its folder's owner."""
    is_yaml = path.name == CAPTURES
    content: Any = read_yaml(path).data if is_yaml else json.loads(path.read_text("utf-8"))
    if not isinstance(content, dict):
        raise ValueError("no mapping")
    subject = content.get("subject")
    return subject if isinstance(subject, str) else None


def _exports(folder: Path, names: list[str], subject: str) -> set[str]:
    """The subject's exports in a folder of no one or another subject, with their JSON files."""
    found: set[str] = set()
    for name in names:
        if name.endswith(".json") and name.removesuffix(".json") in names:
            with suppress(OSError, ValueError):
                if _subject(folder / name) == subject:
                    found |= {name, name.removesuffix(".json")}
    return found


def _without(subject: str, summary: Path) -> str | None:
    """The summary without the subject's rows; None if it has none."""
    try:
        text = summary.read_text("utf-8")
    except OSError:
        return None
    reader = csv.DictReader(io.StringIO(text))
    rows = list(reader)
    kept = [row for row in rows if row.get("subject") != subject]
    if len(kept) == len(rows):
        return None
    written = io.StringIO()
    table = csv.DictWriter(written, reader.fieldnames or ())
    table.writeheader()
    table.writerows(kept)
    return written.getvalue()
