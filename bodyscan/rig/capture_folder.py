"""A capture folder as the rig file names it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated

from pydantic import Field

from bodyscan.files.model import Model, Problem, ShotName, duplicates


class CaptureFolder(Model):
    """A folder of captures, relative to the rig file.

    shots: overrides those of its captures.yaml.
    corners: a corners.vnl, relative to the rig file. Its corners of the rig's only board replace
        those of the images that it names; the images themselves need not exist.
    """

    folder: Annotated[str, Field(min_length=1)]
    files: str | None = None
    shots: tuple[ShotName, ...] | None = None
    corners: Annotated[str, Field(min_length=1)] | None = None

    def problems(self) -> Iterator[Problem]:
        for index, name in duplicates(self.shots or ()):
            yield ("shots", index), f"is a shot named twice ({name})"
