"""Webcams and video files, by OpenCV."""

from __future__ import annotations

from typing import Any, Literal

import cv2

from bodyscan.capture.cameras import Camera, CameraKind, FrameLost, Picture, Place, now_ms
from bodyscan.errors import BadInput


class OpenCvKind(CameraKind):
    """source: a webcam's number, or a video file, relative to the rig file.

    skip: pictures of a webcam that are dropped after a frame is shown, because they were taken before
        it: as many as its driver keeps.
    exposure: of a webcam, in the unit of its driver, which OpenCV hands on; None: as it is.
    """

    kind: Literal["opencv"]
    source: int | str = 0
    skip: int = 2
    exposure: float | None = None

    def open(self, place: Place) -> Camera:
        is_webcam = isinstance(self.source, int)
        source = self.source if is_webcam else str(place.base / str(self.source))
        video = cv2.VideoCapture(source)
        if not video.isOpened():
            raise BadInput(
                f"{'webcam' if is_webcam else 'video'} {source} cannot be opened",
                where=f"pair {place.pair.name}",
                remedy="Possible causes: another program holds it; it has another number; the user may "
                "not read it (group `video` on Linux)",
            )
        if is_webcam:
            self._fix(video, place)
        return OpenCvCamera(video, place.pair.name, self.skip if is_webcam else 0)

    def _fix(self, video: Any, place: Place) -> None:
        """Set the size; fix white balance, focus and exposure, which drivers otherwise follow."""
        settings: dict[int, float] = {
            cv2.CAP_PROP_FRAME_WIDTH: place.pair.camera.width,
            cv2.CAP_PROP_FRAME_HEIGHT: place.pair.camera.height,
            cv2.CAP_PROP_AUTO_WB: 0,
            cv2.CAP_PROP_AUTOFOCUS: 0,
            cv2.CAP_PROP_AUTO_EXPOSURE: 1,  # V4L2: manual
        }
        if self.exposure is not None:
            settings[cv2.CAP_PROP_EXPOSURE] = self.exposure
        for name, value in settings.items():
            video.set(name, value)


class OpenCvCamera(Camera):
    """Pictures as they come; a video file's frames are taken one after another."""

    def __init__(self, video: Any, pair: str, skip: int) -> None:
        self._video, self._pair, self._skip = video, pair, skip
        self.has_clock = skip > 0
        self._triggered_ms = 0.0

    def trigger(self, frame: str) -> None:
        for _ in range(self._skip):
            self._video.grab()
        self._triggered_ms = now_ms()

    def take(self, timeout_s: float) -> Picture:
        there, image = self._video.read()
        if not there:
            raise FrameLost("no frame received", where=f"pair {self._pair}")
        return Picture(image, self._triggered_ms, now_ms())

    def close(self) -> None:
        self._video.release()


FORMAT = OpenCvKind
