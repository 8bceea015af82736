"""What a format holds of a body, and how it is written."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from bodyscan.files.registry import Registry

Content = Literal["mesh", "cloud", "colours", "normals", "sigma", "filled", "regions"]


@dataclass(frozen=True)
class BodyFormat:
    """write: takes a path and a body, mm, z up.  holds: which bodies it takes (mesh, cloud or both)
    and what a reader of the file learns of them.  unit: of the file.  axes: where its x, y and z
    point, as the subject sees it.
    """

    write: Callable[[Path, Any], None]
    holds: frozenset[Content]
    unit: Literal["mm", "m"] = "mm"
    axes: tuple[str, str, str] = ("front", "left", "up")


BODY_FORMATS: Registry[BodyFormat] = Registry("bodyscan.export.formats", "a body")
