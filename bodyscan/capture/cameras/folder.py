"""A camera whose images another program writes into a folder, named as the rig file says."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from bodyscan.capture.cameras import Camera, CameraKind, FrameLost, Picture, Place, now_ms
from bodyscan.files.reading import read_regular
from bodyscan.rig.templates import fill


class FolderKind(CameraKind):
    """folder: relative to the rig file."""

    kind: Literal["folder"]
    folder: str

    def open(self, place: Place) -> Camera:
        return FolderCamera(place, place.base / self.folder)


class FolderCamera(Camera):
    """Waits for each image to be there, whole. A file does not tell when its light was taken."""

    has_clock = False

    def __init__(self, place: Place, folder: Path) -> None:
        self._place, self.folder = place, folder
        self._shot, self._path = "", Path()

    def begin(self, shot: str, frames: Sequence[str]) -> None:
        self._shot = shot

    def trigger(self, frame: str) -> None:
        rig, pair = self._place.rig, self._place.pair.name
        self._path = self.folder / fill(rig.files, shot=self._shot, pair=pair, frame=frame)

    def take(self, timeout_s: float) -> Picture:
        deadline = time.monotonic() + timeout_s
        while True:
            try:
                data = read_regular(self._path)
                image = (
                    cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
                    if data
                    else None
                )
                if image is not None:
                    return Picture(image, now_ms(), now_ms())
            except OSError:
                pass  # not there yet
            if time.monotonic() > deadline:
                raise FrameLost("did not appear in time", where=str(self._path))
            time.sleep(0.01)


FORMAT = FolderKind
