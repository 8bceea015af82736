"""corners.vnl: board corners as mrgingham writes and mrcal reads them.

A text table (vnlog) of `filename x y level`: for every image all corners of its grid, row by row;
`-` for x and y if no board was found; `-` or a negative number for the level of a corner that is
not to be used. Levels above 0 were found in an image reduced by 2**level.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path
from typing import TypeAlias

from bodyscan.errors import CaptureError
from bodyscan.files.atomic import write_text
from bodyscan.files.reading import read_regular

Corners: TypeAlias = tuple[tuple[float, float], ...]
"""Corners of one image, px; NaN if not to be used. Plain numbers, since `check` loads no NumPy."""

_REMEDY = "A corners.vnl has a line `# filename x y level` and below it a line for each corner."


def read_corners(path: Path) -> dict[str, Corners]:
    """Read corners by image name, as in the file; () for an image without a board.

    Raises CaptureError, with the line, if the file is not such a table.
    """
    try:
        lines = read_regular(path, 200_000_000).decode("utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        what = f"cannot be read as text: {error}"
        raise CaptureError(what, where=str(path), remedy=_REMEDY) from None
    order: list[int] = []
    found: dict[str, list[tuple[float, float]]] = {}
    for number, line in enumerate(lines, start=1):
        words = line.split()
        if not words or line.startswith("##"):
            continue
        where = f"{path}:{number}"
        if words[0].startswith("#"):
            names = line.lstrip("#").split()
            if not order and not {"filename", "x", "y"} <= set(names):
                what = f"has the columns {' '.join(names)[:100]}"
                raise CaptureError(what, where=where, remedy=_REMEDY)
            columns = ("filename", "x", "y", "level")
            order = order or [names.index(c) if c in names else -1 for c in columns]
            continue
        if not order:
            what = "comes before the line that names the columns"
            raise CaptureError(what, where=where, remedy=_REMEDY)
        name, corner = _parse_corner(words, order, where)
        corners = found.setdefault(name, [])
        if corner is not None:
            corners.append(corner)
    if not found:
        raise CaptureError("holds no corner", where=str(path), remedy=_REMEDY)
    return {name: tuple(corners) for name, corners in found.items()}


def write_corners(path: Path, corners: Iterable[tuple[str, Corners]]) -> None:
    """Write corners by image name; the file appears complete or not at all."""
    lines = ["# filename x y level"]
    for name, pixels in corners:
        if any(letter.isspace() for letter in name):
            raise CaptureError(
                f"the name {name!r} has a space in it, which corners.vnl cannot hold",
                where=str(path),
                remedy="Rename the image.",
            )
        if not len(pixels):
            lines.append(f"{name} - - -")
        for x, y in pixels:
            lines.append(f"{name} {x:.6f} {y:.6f} 0" if x == x else f"{name} 0 0 -")
    write_text(path, "\n".join(lines) + "\n")


def _parse_corner(
    words: list[str], order: list[int], where: str
) -> tuple[str, tuple[float, float] | None]:
    """Parse an image's name and its next corner; None for an image without a board."""
    name, x, y, level = (words[k] if 0 <= k < len(words) else "" for k in order)
    try:
        if not (name and x and y):
            raise ValueError("columns are missing")
        if "-" in (x, y):
            return name, None
        corner = float(x), float(y)
        if level == "-" or float(level or 0) < 0.0:
            return name, (math.nan, math.nan)
        if all(map(math.isfinite, corner)):
            return name, corner
    except ValueError:
        pass
    shown = " ".join(words)[:100]
    raise CaptureError(f"is not an image and a corner: {shown}", where=where, remedy=_REMEDY)
