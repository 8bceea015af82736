"""File-name templates such as `{shot}/{pair}/{frame}.png`: checked, filled in, read backwards.

`*` stands for any part of a name, such as the time: a path with it is a pattern of names. At the end
`.*` stands for the suffixes of images.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import lru_cache
from string import Formatter

from bodyscan.files.model import SHOT

ANYTHING = "*"


def fill(template: str, *, shot: str, pair: str, frame: str) -> str:
    """Fill in a template without `find_template_faults`; returns a relative path."""
    return template.format(shot=shot, pair=pair, frame=frame)


def has_field(template: str, field: str) -> bool:
    return field in _parse_fields(template)


def compile_names(path: str) -> tuple[re.Pattern[str], ...]:
    """Compile patterns for the names that each part of a path, with ANYTHING in it, matches."""
    return tuple(re.compile(part) for part in _split_pattern(path))


@lru_cache(maxsize=4096)
def compile_shot_pattern(template: str, pair: str, frame: str) -> tuple[re.Pattern[str], ...]:
    """Compile one pattern per part of a path; together they find the shot (group `shot`) in it."""
    marked = _split_pattern(fill(template, shot="\0", pair=pair, frame=frame))
    return tuple(_compile_part(part) for part in marked)


def find_template_faults(
    template: str, many_pairs: bool, needs_frame: bool, exposures: bool = False
) -> Iterator[str]:
    """Find what is wrong with a file-name template, as messages that follow its key."""
    try:
        fields = _parse_fields(template)
    except ValueError as error:
        yield f"is not a file-name template: {error}"
        return
    if many_pairs and "pair" not in fields:
        yield "needs {pair}, since the rig has several pairs"
    if needs_frame and "frame" not in fields:
        yield "needs {frame}, since a stripe sequence has many images"
    if needs_frame and exposures and "exposure" not in fields:
        yield "needs {exposure}, since every image is taken with several exposures"
    if "exposure" in fields and not exposures:
        yield "holds {exposure}, but the rig file names no `exposures`"
    videos = (".mp4", ".m4v", ".avi", ".mov", ".mkv", ".webm", ".wmv", ".mpg", ".mpeg")
    suffixes = (".png", ".tif", ".tiff", ".bmp", ".jpg", ".jpeg", ".*")
    if template.lower().endswith(videos):
        images = f"{template.rpartition('.')[0]}/%04d.png"
        yield (
            "names a video: unpack each with `ffmpeg -i VIDEO -fps_mode passthrough -start_number 0"
            f" FOLDER/%04d.png`, write {images.replace('%04d', '{frame}')!r} here, and under `frames`"
            " the numbers of the images, such as '0000'"
        )
    elif not template.lower().endswith(suffixes):
        yield (
            f"must end in {', '.join(suffixes[:-1])}, or .* for any of these: only PNG, TIFF, BMP and "
            "JPEG images are read"
        )
    fault = find_path_fault(template)
    if fault:
        yield fault


def find_frame_name_faults(name: str, number: str) -> Iterator[str]:
    """Find what is wrong with a name such as `frames.pattern`, which holds `{bit}` (`number`)."""
    try:
        parts = list(Formatter().parse(name))
    except ValueError as error:
        yield f"is not a frame name: {error}"
        return
    fields = [(field, spec, how) for _, field, spec, how in parts if field is not None]
    if not fields:
        yield f"needs {{{number}}}, or must be a list of one name a {number}, such as [{name}]"
    for field, spec, how in fields:
        if field != number or how or not re.fullmatch(r"0?[1-9]?d?", spec or ""):
            yield f"may only hold {{{number}}} or such as {{{number}:02d}}, not {{{field}}}"


def find_path_fault(path: str) -> str | None:
    """Return why a relative path might lead out of its starting folder, or None."""
    if "\\" in path or "\0" in path or re.match(r"[A-Za-z]:", path):
        return "must use / between folders, and neither \\ nor a drive letter"
    if path.startswith("/"):
        return "must be relative to the capture folder"
    parts = path.split("/")
    if ".." in parts:
        return "must not climb out of the capture folder with .."
    return "has an empty part between two /" if "" in parts else None


def _parse_fields(template: str) -> set[str]:
    """Parse the fields of a template. Raises ValueError for unknown ones."""
    known, fields = ("shot", "pair", "frame", "exposure"), set()
    for _, field, spec, conversion in Formatter().parse(template):
        if field is None:
            continue
        if field in known and (spec or conversion):
            raise ValueError(
                f"write {{{field}}} without {f':{spec}' if spec else f'!{conversion}'}; names, such as "
                "'007', are written out under `frames`, `exposures` and `shots`"
            )
        if field not in known:
            allowed = ", ".join(f"{{{name}}}" for name in known)
            raise ValueError(f"it may hold {allowed}, not {{{field}}}")
        fields.add(field)
    return fields


def _compile_part(part: str) -> re.Pattern[str]:
    """Compile one part of a path, in which NUL marks the shot."""
    first, *others = part.split(re.escape("\0"))
    if not others:
        return re.compile(first)
    return re.compile(first + f"(?P<shot>{SHOT})" + "(?P=shot)".join(others))


def _split_pattern(path: str) -> list[str]:
    """Regular expressions for the parts of a path."""
    suffix = r"\.(?i:png|tiff?|bmp|jpe?g)" if path.endswith(f".{ANYTHING}") else ""
    rest = path[: -len(f".{ANYTHING}")] if suffix else path
    return (re.escape(rest).replace(re.escape(ANYTHING), ".*") + suffix).split("/")
