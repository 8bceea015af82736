"""The formats in which a body is written: one module each, named as the format, with its FORMAT."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from bodyscan.files.registry import Registry

Content = Literal["mesh", "cloud", "colours", "normals", "sigma", "filled", "regions", "texture"]


@dataclass(frozen=True)
class BodyFormat:
    """One file format.

    write: writes a body, mm, to a path.
    holds: which bodies it takes (mesh, cloud or both) and what a reader of the file learns about
        them.
    unit: of the file.
    axes: where its x, y and z point, as the subject sees it.
    write_skinned: writes a registered body with its parts and what else the format holds of it; None
        if it is no more than its mesh to it.
    free_axes: whether its standard leaves the axes open. Both functions then take a third argument,
        which axis of the file points up: see `lay_axes`.

    If it holds textures, both functions take one as `texture`.
    """

    write: Callable[..., None]
    holds: frozenset[Content]
    unit: Literal["mm", "m"] = "mm"
    axes: tuple[str, str, str] = ("front", "left", "up")
    write_skinned: Callable[..., None] | None = None
    free_axes: bool = False


BODY_FORMATS: Registry[BodyFormat] = Registry("bodyscan.export.formats", "a body")
