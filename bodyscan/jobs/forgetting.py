"""Every file of a subject in a workspace, found by the files' content and never by their names.

A folder is a subject's if its captures.yaml, scan.json or job.json says so, together with
everything below it that is not another subject's, and the images that the job was made from.
Elsewhere an export or report is recognised by the JSON beside it, and measurements by their own
content. Rows of our tables and entries of manifests about the subject are removed too. What may
show a person and names none is listed.
"""

from __future__ import annotations

import csv
import io
import json
import os
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bodyscan.captures.captures_file import FILE_NAME as CAPTURES
from bodyscan.errors import BadInput
from bodyscan.files.atomic import lock_file, restrict_to_owner, write_text
from bodyscan.files.yaml_file import YamlError, read_yaml
from bodyscan.jobs.job import BATCH_LOCK, CALIBRATION, JOB, MANIFEST
from bodyscan.jobs.summary import write_out_manifest

# Removed in this order, who names the owner last: an interrupted removal can be continued.
_MARKERS = ("scan.json", JOB, CAPTURES)

_Folder = tuple[Path, list[str], str | bool | None]
"""A folder, the names of its files (and links), and its owner: a subject; None if nothing says so;
False for boards and calibrations, which are of nobody."""


@dataclass(frozen=True)
class SubjectFiles:
    """What belongs to a subject."""

    files: tuple[Path, ...]  # of the subject
    folders: tuple[Path, ...]  # of the subject alone
    tables: tuple[Path, ...]  # folders of batches, whose manifests are rewritten
    rows: tuple[Path, ...]  # our tables, or copies of them, that have rows of the subject
    unreadable: tuple[Path, ...]  # files that should name a folder's owner, and do not
    # Folders whose images or bodies name nobody, with how many there are in and below them.
    unnamed: dict[Path, int]


def find_subject(subject: str, workspace: Path) -> SubjectFiles:
    """Find what `forget_subject` would remove. Raises BadInput if the workspace is not a folder."""
    if not workspace.is_dir():
        raise BadInput("there is no such folder", where=str(workspace), remedy="check --workspace")
    files: list[Path] = []
    folders: list[Path] = []
    tables: list[Path] = []
    unreadable: list[Path] = []
    unnamed: dict[Path, int] = {}
    named = {workspace, *workspace.parents}
    walked = list(_walk(workspace, None, unreadable))
    sources = _find_sources(subject, walked)
    for folder, names, owner in walked:
        if owner is None and sources & {folder, *folder.parents}:
            owner = subject
        found = set(names) if owner == subject else _find_exports(folder, names, subject)
        files += (folder / name for name in found)
        if owner == subject and folder != workspace:
            folders.append(folder)
        if BATCH_LOCK in names and owner is None:
            tables.append(folder)
        if owner is not None:
            named |= {folder, *folder.parents}
        elif count := sum(_may_show_someone(name, names) for name in names if name not in found):
            unnamed[folder] = count
    order = {name: rank for rank, name in enumerate(_MARKERS, start=1)}
    files.sort(key=lambda path: (order.get(path.name, 0), path))
    every = {folder / name for folder, names, _ in walked for name in names} - set(files)
    rows = [path for path in sorted(every) if path.suffix == ".csv" and _drop_rows(subject, path)]
    return SubjectFiles(
        *(tuple(files), tuple(folders), tuple(tables), tuple(rows), tuple(unreadable)),
        _count_by_folder(unnamed, named),
    )


def _find_sources(subject: str, walked: Sequence[_Folder]) -> set[Path]:
    """Folders of images that name nobody, from which the subject's jobs were made."""
    owners = {folder.resolve(): (folder, owner) for folder, _, owner in walked}
    sources = set()
    for folder, names, owner in walked:
        if owner == subject and JOB in names:
            with suppress(OSError, ValueError, KeyError, TypeError):
                content = json.loads((folder / JOB).read_text("utf-8"))
                source, its = owners[(folder / content["source"]).resolve()]
                sources |= {source} if its is None else set()
    return sources


def _may_show_someone(name: str, names: Sequence[str]) -> bool:
    """Whether a file may be an image or a body, and has no JSON beside it."""
    images = (".png", ".tif", ".tiff", ".bmp", ".jpg", ".jpeg", ".pgm", ".exr", ".npy")
    bodies = (".ply", ".obj", ".stl", ".glb", ".e57", ".html", ".lnd")
    return name.lower().endswith((*images, *bodies)) and f"{name}.json" not in names


def _count_by_folder(unnamed: Mapping[Path, int], named: Collection[Path]) -> dict[Path, int]:
    """Count by the highest folder that holds nothing which is known to be of someone, or no one."""
    counts: Counter[Path] = Counter()
    for folder, count in unnamed.items():
        highest = [path for path in (folder, *folder.parents) if path not in named]
        counts[highest[-1] if highest else folder] += count
    return dict(counts)


def forget_subject(subject: str, workspace: Path) -> SubjectFiles:
    """Remove every file of a subject in a workspace; links are removed, never followed.

    Raises BadInput if there is nothing of that subject, or a batch is working in the workspace.
    """
    with ExitStack() as locks:
        locks.enter_context(restrict_to_owner())
        found = find_subject(subject, workspace)
        for out in found.tables:
            locks.enter_context(lock_file(out / BATCH_LOCK, wait=False))
        require_found(found, subject, workspace)
        for table in found.rows:
            write_text(table, _drop_rows(subject, table))
        for path in found.files:
            path.unlink(missing_ok=True)
        for folder in sorted(found.folders, reverse=True):
            with suppress(OSError):  # it holds something of another subject
                folder.rmdir()
        for out in found.tables:
            if (out / MANIFEST).exists():
                write_out_manifest(out)
    return found


def list_by_folder(found: SubjectFiles) -> Iterator[str]:
    """What was found: the subject's highest folders with their number of files, and other files."""
    highest = [one for one in found.folders if not {*one.parents} & {*found.folders}]
    inside = {path: [one for one in highest if one in path.parents] for path in found.files}
    counts = Counter(one for folders in inside.values() for one in folders)
    yield from (f"{folder} ({counts[folder]} files)" for folder in highest)
    yield from (str(path) for path, folders in inside.items() if not folders)
    yield from (f"the subject's rows of {table}" for table in found.rows)


def require_found(found: SubjectFiles, subject: str, workspace: Path) -> None:
    """Raise BadInput if there is nothing of that subject."""
    if not found.files and not found.rows:
        raise BadInput(
            f"holds nothing of subject {subject!r}",
            where=str(workspace),
            remedy="give the pseudonym as captures.yaml has it, and the --workspace",
        )


def _walk(folder: Path, owner: str | bool | None, unreadable: list[Path]) -> Iterator[_Folder]:
    """Every folder in and below `folder`, which is `owner`'s unless it says otherwise."""
    with os.scandir(folder) as entries:
        listed = sorted(entries, key=lambda entry: entry.name)
    names = [entry.name for entry in listed if not entry.is_dir(follow_symlinks=False)]
    if CALIBRATION in names and owner is None:
        owner = False
    for marker in _MARKERS:
        if marker in names:
            try:
                content = _read_mapping(folder / marker)
            except (OSError, ValueError, YamlError, RecursionError):
                unreadable.append(folder / marker)
                continue
            is_boards = marker == CAPTURES and content.get("kind") == "calibration"
            subject = content.get("subject")
            named = subject if isinstance(subject, str) else None
            owner = named or (False if is_boards else owner)
    yield folder, names, owner
    for entry in listed:
        if entry.is_dir(follow_symlinks=False):
            yield from _walk(Path(entry.path), owner, unreadable)


def _read_mapping(path: Path) -> dict[str, Any]:
    """The mapping in a JSON file or captures.yaml. Raises ValueError, YamlError."""
    is_yaml = path.name == CAPTURES
    content: Any = read_yaml(path).data if is_yaml else json.loads(path.read_text("utf-8"))
    if not isinstance(content, dict):
        raise ValueError("no mapping")
    return content


def _find_exports(folder: Path, names: list[str], subject: str) -> set[str]:
    """The subject's exports, reports and measurements in a folder of no one or another subject."""
    found: set[str] = set()
    for name in names:
        described = name.removesuffix(".json")
        if not name.endswith(".json") or name in _MARKERS:
            continue
        with suppress(OSError, ValueError, RecursionError):
            content = _read_mapping(folder / name)
            is_ours = str(content.get("schema")).startswith("bodyscan-")
            whose = (content.get("subject"), content.get("compared_with"))
            if subject in whose and (described in names or is_ours):
                found |= {name, described, *map(str, content.get("companions") or ())} & {*names}
    return found


def _drop_rows(subject: str, path: Path) -> str:
    """A table without the subject's rows; "" if it has none, or is not of ours: those begin so."""
    try:
        with path.open(encoding="utf-8", newline="") as stream:
            if not stream.readline().startswith(("subject,when,", "job,subject,when,")):
                return ""
            stream.seek(0)
            rows = list(csv.reader(stream))
    except (OSError, ValueError, csv.Error):
        return ""
    column = rows[0].index("subject")
    kept = [row for row in rows if row[column : column + 1] != [subject]]
    if len(kept) == len(rows):
        return ""
    written = io.StringIO()
    csv.writer(written).writerows(kept)
    return written.getvalue()
