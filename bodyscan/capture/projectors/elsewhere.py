"""A projector that this program does not drive: another program's, or the simulator's."""

from __future__ import annotations

from typing import Literal

from bodyscan.capture.cameras import Place
from bodyscan.capture.projectors import Projector, ProjectorKind


class ElsewhereKind(ProjectorKind):
    """Whatever shows the patterns does so by itself."""

    kind: Literal["elsewhere"]

    def open(self, place: Place) -> Projector:
        return Elsewhere()


class Elsewhere(Projector):
    """Shows nothing."""

    def show(self, frame: str) -> None:
        pass


FORMAT = ElsewhereKind
