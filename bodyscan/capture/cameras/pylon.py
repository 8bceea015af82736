"""Basler cameras, by pypylon; their emulator too, which delivers the PNG files of a folder."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np

from bodyscan.capture.cameras import (
    HOST,
    Camera,
    CameraKind,
    FrameLost,
    Picture,
    Place,
    fix_nodes,
    now_ms,
)
from bodyscan.errors import BadInput

TICKS_PER_MS = 1e6
"""Basler's clocks count nanoseconds (all models but some of the oldest, whose clock is not used)."""


class PylonKind(CameraKind):
    """Which camera, and who triggers it.

    serial: its number; None: the first that is free.
    line: the input at which the projector triggers it, such as Line1; None: by this program.
    bits: 8, or as many as the camera has.
    gain_db: fixed.
    images: of the emulator: the folder of PNG that it delivers by name, relative to the rig file.
    """

    kind: Literal["pylon"]
    serial: str | None = None
    line: str | None = None
    bits: Literal[8, 10, 12] = 8
    gain_db: float = 0.0
    images: str | None = None

    def open(self, place: Place) -> Camera:
        try:
            from pypylon import pylon
        except ImportError as error:
            raise BadInput(
                "a Basler camera needs the package pypylon, which is not installed",
                where=f"pair {place.pair.name}",
                remedy="pip install 'bodyscan[capture-pylon]'",
            ) from error
        wanted = pylon.DeviceInfo()
        if self.serial is not None:
            wanted.SetSerialNumber(self.serial)
        taken = place.shared.setdefault("pylon", set())
        found = [
            one
            for one in pylon.TlFactory.GetInstance().EnumerateDevices([wanted])
            if one.GetFullName() not in taken
        ]
        if not found:
            raise BadInput(
                f"there is no Basler camera {self.serial or 'left'}",
                where=f"pair {place.pair.name}",
                remedy="look at its cable and power; pylon's own viewer lists cameras by serial number",
            )
        taken.add(found[0].GetFullName())
        handle = pylon.InstantCamera(pylon.TlFactory.GetInstance().CreateDevice(found[0]))
        return PylonCamera(self, place, handle)


class PylonCamera(Camera):
    """A camera in trigger mode, whose buffers wait until they are taken."""

    def __init__(self, kind: PylonKind, place: Place, handle: Any) -> None:
        self._kind, self._pair, self._handle = kind, place.pair.name, handle
        self._next: int | None = None
        self._early: tuple[int, Picture] | None = None
        self._triggered_ms = 0.0
        handle.Open()
        nodes: dict[str, object] = {"PixelFormat": f"Mono{kind.bits}", "Gain": kind.gain_db}
        if kind.images is not None:
            size = {"Width": place.pair.camera.width, "Height": place.pair.camera.height}
            nodes |= {"ImageFilename": str(place.base / kind.images), "ImageFileMode": "On"}
            nodes |= {"TestImageSelector": "Off", **size}
        fix_nodes(handle, "Value", kind.line, **nodes)
        self.exposure_ms = handle.ExposureTime.Value / 1000.0

    def expose(self, exposure_ms: float) -> None:
        node = self._handle.ExposureTime
        node.Value = min(max(1000.0 * exposure_ms, node.Min), node.Max)
        self.exposure_ms = node.Value / 1000.0

    def begin(self, shot: str, frames: Sequence[str]) -> None:
        from pypylon import pylon

        self._handle.StopGrabbing()
        self._handle.MaxNumBuffer.Value = len(frames) + 4  # none is dropped while others are taken
        self._handle.StartGrabbing(pylon.GrabStrategy_OneByOne)
        self._next, self._early = None, None

    def trigger(self, frame: str) -> None:
        if self._kind.line is not None:
            return
        from pypylon import pylon

        # Triggered before it is ready, a camera swallows the trigger.
        if not self._handle.WaitForFrameTriggerReady(2000, pylon.TimeoutHandling_Return):
            raise self._make_lost("was not ready for its trigger")
        self._triggered_ms = now_ms()
        self._handle.ExecuteSoftwareTrigger()

    def take(self, timeout_s: float) -> Picture:
        """As `Camera.take`. Where the projector triggers, a gap in the numbers of blocks is a frame
        that was lost, and the picture after it waits for its turn."""
        if self._early is None:
            self._early = self._retrieve(timeout_s)
        number, picture = self._early
        expected, self._next = self._next, (number if self._next is None else self._next) + 1
        if self._kind.line is not None and expected is not None and number > expected:
            raise self._make_lost(f"frame {expected} was dropped")
        self._early = None
        return picture

    def _retrieve(self, timeout_s: float) -> tuple[int, Picture]:
        """The next buffer's number, and its picture."""
        from pypylon import pylon

        milliseconds = int(1000.0 * timeout_s)
        with self._handle.RetrieveResult(milliseconds, pylon.TimeoutHandling_Return) as buffer:
            if not buffer.IsValid():
                raise self._make_lost("timed out waiting for a frame")
            if not buffer.GrabSucceeded():
                raise self._make_lost(f"a frame is damaged: {buffer.ErrorDescription}")
            image, received_ms = np.array(buffer.Array), now_ms()
            ticks, exposure_ms = buffer.TimeStamp, self.exposure_ms or 0.0
            began_ms, clock = ticks / TICKS_PER_MS, f"camera {self._pair}"
            if not ticks:  # this camera has no clock
                began_ms, clock = received_ms - exposure_ms, HOST
                if self._kind.line is None:
                    began_ms = self._triggered_ms
            return buffer.BlockID, Picture(image, began_ms, received_ms, exposure_ms, clock)

    def _make_lost(self, what: str) -> FrameLost:
        return FrameLost(what, where=f"pair {self._pair}")

    def close(self) -> None:
        self._handle.StopGrabbing()
        self._handle.Close()


FORMAT = PylonKind
