"""Where a rig's captures lie."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated

from pydantic import Field

from bodyscan.files.model import Model, Name, Problem, duplicates


class CaptureFolder(Model):
    """A folder of captures; relative to the rig file. `shots` overrides its captures.yaml."""

    folder: Annotated[str, Field(min_length=1)]
    files: str | None = None
    shots: tuple[Name, ...] | None = None

    def problems(self) -> Iterator[Problem]:
        for index, name in duplicates(self.shots or ()):
            yield ("shots", index), f"is a shot named twice ({name})"
