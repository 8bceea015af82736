"""Images in a capture folder that the rig file does not name: often a folder was renamed."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from bodyscan.captures.folder import SUFFIXES, Captures


def describe_unlisted_images(captures: Captures) -> str | None:
    """Say how many there are and name one; None if there are none."""
    found = find_unlisted_images(captures)
    if not found:
        return None
    number = "1 image belongs" if len(found) == 1 else f"{len(found)} images belong"
    return (
        f"{number} to no pair and frame of the rig file, such as {found[0]}; is a name spelt "
        "differently?"
    )


def find_unlisted_images(captures: Captures) -> list[Path]:
    """Images next to those of the captures' shots that belong to no pair and frame of the rig file.

    Shots that are not wanted are ignored, unless nothing is left of one that is: it may have been
    renamed.
    """
    seen = {s.shot for s in captures.sequences if len(s.missing) < len(s.paths)}
    renamed = any(shot not in seen for shot in captures.shots)
    wanted = {path for sequence in captures.sequences for path in sequence.paths}
    beside = {path.parent.parent for path in wanted} | {path.parent for path in wanted}
    named = {(len(path.parts), path.stem) for path in wanted}
    suffixes = {path.suffix for path in wanted}
    return sorted(
        path
        for folder in captures.folders
        for path in _images(folder)
        if path not in wanted
        and (
            renamed
            or _belongs(path.relative_to(folder), captures, path.parent in beside)
            # of another shot whose name differs only in its suffix
            or (path.suffix not in suffixes and (len(path.parts), path.stem) in named)
        )
    )


def _images(folder: Path) -> Iterator[Path]:
    for place, _, names in os.walk(folder):
        yield from (Path(place) / n for n in names if Path(n).suffix.lower() in SUFFIXES)


def _belongs(relative: Path, captures: Captures, beside: bool) -> bool:
    """Whether a file lies where images of a wanted shot lie."""
    return beside or any(part in captures.shots for part in relative.parts[:-1])
