"""Projectors by kind: each is one file in this folder, with its FORMAT, or another package's entry
point in the group `bodyscan.capture.projectors`; `elsewhere`, which shows nothing, is here.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Annotated, Literal

from pydantic import Field

from bodyscan.arrays import Bytes
from bodyscan.capture.cameras import Place
from bodyscan.files.model import Model
from bodyscan.files.registry import Registry

Size = Annotated[int, Field(gt=0, le=32767)]


class Projector(ABC):
    """An open projector.

    any_order: whether it shows any pattern at any time; otherwise a lost frame costs the sequence.
    delay_ms: from `show` until its light is on; None: not measured yet.
    """

    any_order: bool = True
    delay_ms: float | None = 0.0

    def load(self, patterns: Mapping[str, Bytes]) -> None:  # noqa: B027  # some have them stored
        """Take over the images (height, width) uint8 by frame, those of the board image included."""

    def begin(self, frames: Sequence[str]) -> None:  # noqa: B027
        """Prepare to show these frames in that order."""

    @abstractmethod
    def show(self, frame: str) -> None:
        """Show a frame; its light is on `delay_ms` after this returns."""

    def rest(self) -> None:  # noqa: B027
        """Show nothing: other projectors' light must not be disturbed."""

    def close(self) -> None:  # noqa: B027
        """Release the device."""


class ProjectorKind(Model):
    """What a rig file says of a projector: its keys below `capture.projector`.

    width, height: of its image, px.
    delay_ms: from `show` to light; if left out, it is measured before the first capture.
    """

    kind: str
    width: Size = 1920
    height: Size = 1080
    delay_ms: Annotated[float, Field(ge=0.0, le=1000.0)] | None = None

    @abstractmethod
    def open(self, place: Place) -> Projector:
        """Open the projector of a pair. Raises BadInput if it is not there."""


class ElsewhereKind(ProjectorKind):
    """One that this program does not drive: another program's, or the simulator's."""

    kind: Literal["elsewhere"]

    def open(self, place: Place) -> Projector:
        return Elsewhere()


class Elsewhere(Projector):
    """Shows nothing."""

    def show(self, frame: str) -> None:
        pass


PROJECTORS: Registry[type[ProjectorKind]] = Registry(
    __name__, "a projector", "cannot be of kind", {"elsewhere": ElsewhereKind}
)
