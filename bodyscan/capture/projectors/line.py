"""A projector with stored patterns, stepped or started by a pulse on a serial port's RTS line."""

from __future__ import annotations

import os
import struct
import time
from collections.abc import Sequence
from typing import Literal

from bodyscan.capture.cameras import Place
from bodyscan.capture.projectors import Projector, ProjectorKind
from bodyscan.errors import BadInput


class LineKind(ProjectorKind):
    """port: the serial port, such as /dev/ttyUSB0, whose RTS line leads to the trigger input.

    each: frame: a pulse shows the next frame; sequence: one pulse starts all of them, and the projector
        triggers the cameras (give these their `line`).
    pulse_ms: how long the line is high.

    The patterns that `bodyscan patterns` writes are stored in the projector beforehand, in its order.
    """

    kind: Literal["line"]
    port: str
    each: Literal["frame", "sequence"] = "frame"
    pulse_ms: float = 1.0

    def open(self, place: Place) -> Projector:
        try:
            handle = os.open(place.base / self.port, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        except OSError as error:
            raise BadInput(
                f"the port {self.port} cannot be opened: {error.strerror}",
                where=f"pair {place.pair.name}",
                remedy="plug the adapter in; your user must be in the group `dialout` on Linux",
            ) from error
        return Line(self, handle)


class Line(Projector):
    """handle: of the open port."""

    any_order = False

    def __init__(self, kind: LineKind, handle: int) -> None:
        self._kind, self._handle, self._first = kind, handle, ""

    def begin(self, frames: Sequence[str]) -> None:
        self._first = frames[0]

    def show(self, frame: str) -> None:
        if self._kind.each == "sequence" and frame != self._first:
            return
        _set_line(self._handle, True)
        time.sleep(self._kind.pulse_ms / 1000.0)
        _set_line(self._handle, False)

    def close(self) -> None:
        os.close(self._handle)


def _set_line(handle: int, high: bool) -> None:
    import fcntl  # POSIX only
    import termios

    request = termios.TIOCMBIS if high else termios.TIOCMBIC
    fcntl.ioctl(handle, request, struct.pack("I", termios.TIOCM_RTS))


FORMAT = LineKind
