"""A projector that is a display: a full-screen window, by pyglet."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any, Literal

import numpy as np

from bodyscan.arrays import Bytes
from bodyscan.capture.cameras import Place
from bodyscan.capture.projectors import Projector, ProjectorKind
from bodyscan.errors import BadInput, FailedWork


class WindowKind(ProjectorKind):
    """display: its number, from 0, in the order in which the system lists displays."""

    kind: Literal["window"]
    display: int = 1

    def open(self, place: Place) -> Projector:
        where = f"pair {place.pair.name}"
        try:
            import pyglet
        except ImportError as error:
            raise BadInput(
                "a window needs the package pyglet, which is not installed",
                where=where,
                remedy="pip install 'bodyscan[capture]'",
            ) from error
        screens = pyglet.display.get_display().get_screens()
        if not 0 <= self.display < len(screens):
            raise BadInput(
                f"there is no display {self.display}: the system lists {len(screens)}",
                where=where,
                remedy="switch the projector on, and let it extend the desktop, not mirror it",
            )
        screen = screens[self.display]
        if (screen.width, screen.height) != (self.width, self.height):
            raise BadInput(
                f"display {self.display} has {screen.width} x {screen.height} px, not {self.width} x "
                f"{self.height}",
                where=where,
                remedy="write the projector's own size as `width` and `height`: what is scaled is no "
                "pattern",
            )
        window = pyglet.window.Window(
            fullscreen=True, screen=screen, vsync=True, caption="bodyscan"
        )
        window.set_mouse_visible(False)
        shown = Window(pyglet, window)
        shown.refuse_unsynchronised(where)
        return shown


class Window(Projector):
    """One pattern a refresh of the display: `show` returns when the display has been handed it."""

    delay_ms = None

    def __init__(self, pyglet: Any, window: Any) -> None:
        self._pyglet, self._window = pyglet, window
        self._patterns: dict[str, Any] = {}
        self._black = self._upload(np.zeros((window.height, window.width), np.uint8))

    def load(self, patterns: Mapping[str, Bytes]) -> None:
        self._patterns = {frame: self._upload(image) for frame, image in patterns.items()}

    def show(self, frame: str) -> None:
        self._draw(self._patterns[frame])

    def rest(self) -> None:
        self._draw(self._black)

    def close(self) -> None:
        self._window.close()

    def refuse_unsynchronised(self, where: str) -> None:
        """Raise FailedWork if the window does not wait for its display: patterns would be torn."""
        self._draw(self._black)
        since = time.perf_counter()
        for _ in range(30):
            self._draw(self._black)
        hertz = 30.0 / (time.perf_counter() - since)
        if hertz > 400.0:  # no projector refreshes as often
            raise FailedWork(
                f"the window is drawn {hertz:.0f} times a second: it does not wait for its display",
                where=where,
                remedy="switch on vertical synchronisation in the graphics driver's settings",
            )

    def _upload(self, image: Bytes) -> Any:
        """An image (height, width), top row first, as the texture that pyglet draws from below."""
        height, width = image.shape
        data = np.ascontiguousarray(np.repeat(image[::-1, :, None], 3, axis=2)).tobytes()
        return self._pyglet.image.ImageData(width, height, "RGB", data).get_texture()

    def _draw(self, texture: Any) -> None:
        self._window.switch_to()
        self._window.dispatch_events()
        texture.blit(0, 0)
        self._window.flip()
        self._pyglet.gl.glFinish()  # until the display has it


FORMAT = WindowKind
