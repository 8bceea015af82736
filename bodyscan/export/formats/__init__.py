"""The formats in which a body is written: one module each, named as the format, with its FORMAT."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from bodyscan.files.registry import Registry

Content = Literal["mesh", "cloud", "colours", "normals", "sigma", "filled", "regions"]


@dataclass(frozen=True)
class BodyFormat:
    """One file format.

    write: writes a body, mm, z up, to a path.
    holds: which bodies it takes (mesh, cloud or both) and what a reader of the file learns about
        them.
    unit: of the file.
    axes: where its x, y and z point, as the subject sees it.
    """

    write: Callable[[Path, Any], None]
    holds: frozenset[Content]
    unit: Literal["mm", "m"] = "mm"
    axes: tuple[str, str, str] = ("front", "left", "up")


BODY_FORMATS: Registry[BodyFormat] = Registry("bodyscan.export.formats", "a body")
