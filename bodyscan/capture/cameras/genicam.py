"""Any GenICam camera (GigE Vision, USB3 Vision, CameraLink), by harvesters and its maker's producer."""

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


class GenicamKind(CameraKind):
    """producer: the maker's GenTL producer (a .cti file).

    serial: its number; None: the first that is free.
    line: the input at which the projector triggers it; None: by this program.
    gain_db: fixed.
    ticks_per_ms: of its clock: nanoseconds, unless its manual says otherwise; 0: it has none.
    """

    kind: Literal["genicam"]
    producer: str
    serial: str | None = None
    line: str | None = None
    gain_db: float = 0.0
    ticks_per_ms: float = 1e6

    def open(self, place: Place) -> Camera:
        try:
            from harvesters.core import Harvester
        except ImportError as error:
            raise BadInput(
                "a GenICam camera needs the package harvesters, which is not installed",
                where=f"pair {place.pair.name}",
                remedy="pip install 'bodyscan[capture-genicam]'",
            ) from error
        harvester = place.shared.get(self.producer)
        if harvester is None:
            harvester = place.shared[self.producer] = Harvester()
            place.closing.callback(harvester.reset)
            harvester.add_file(str(place.base / self.producer))
            harvester.update()
        taken = place.shared.setdefault("genicam", set())
        names = [one.serial_number for one in harvester.device_info_list]
        free = [k for k, name in enumerate(names) if name not in taken]
        found = [k for k in free if self.serial in (None, names[k])]
        if not found:
            raise BadInput(
                f"there is no camera {self.serial or 'left'}",
                where=f"pair {place.pair.name}",
                remedy=f"the producer sees {', '.join(map(str, names)) or 'none'}: look at cables",
            )
        taken.add(names[found[0]])
        return GenicamCamera(self, place.pair.name, harvester.create(found[0]))


class GenicamCamera(Camera):
    """A camera in trigger mode. handle: harvesters' image acquirer."""

    def __init__(self, kind: GenicamKind, pair: str, handle: Any) -> None:
        self._kind, self._pair, self._handle = kind, pair, handle
        self._nodes = handle.remote_device.node_map
        self._triggered_ms = 0.0
        fix_nodes(self._nodes, "value", kind.line, Gain=kind.gain_db)
        self.exposure_ms = self._nodes.ExposureTime.value / 1000.0

    def expose(self, exposure_ms: float) -> None:
        self._nodes.ExposureTime.value = 1000.0 * exposure_ms
        self.exposure_ms = self._nodes.ExposureTime.value / 1000.0

    def begin(self, shot: str, frames: Sequence[str]) -> None:
        self._handle.stop()
        self._handle.num_buffers = len(frames) + 4  # none is dropped while others are taken
        self._handle.start()

    def trigger(self, frame: str) -> None:
        self._triggered_ms = now_ms()
        if self._kind.line is None:
            self._nodes.TriggerSoftware.execute()

    def take(self, timeout_s: float) -> Picture:
        buffer = self._handle.try_fetch(timeout=timeout_s)
        if buffer is None:
            raise FrameLost("timed out waiting for a frame", where=f"pair {self._pair}")
        with buffer:
            if not buffer.payload.components:
                raise FrameLost("a frame is damaged", where=f"pair {self._pair}")
            part, received_ms = buffer.payload.components[0], now_ms()
            image = np.array(part.data).reshape(part.height, part.width)
            exposure_ms, ticks = self.exposure_ms or 0.0, self._kind.ticks_per_ms
            if ticks:
                clock, began_ms = f"camera {self._pair}", buffer.timestamp / ticks
            else:
                clock, began_ms = HOST, self._triggered_ms
            return Picture(image, began_ms, received_ms, exposure_ms, clock)

    def close(self) -> None:
        self._handle.stop()
        self._handle.destroy()


FORMAT = GenicamKind
