"""Before a capture: the exposure of each camera, and how long a projector takes to show a frame."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from bodyscan.arrays import Bytes
from bodyscan.capture.cameras import HOST, Camera, Picture, now_ms
from bodyscan.capture.devices import Devices
from bodyscan.capture.projectors import Projector
from bodyscan.errors import FailedWork

MAX_SATURATED = 0.01
"""Share of the lit part that may be white: a highlight on skin takes less, a white shirt more."""


@dataclass(frozen=True)
class Exposure:
    """What a camera saw under its projector's light."""

    exposure_ms: float
    lit: float = 0.0  # share of its image that the projector lights
    # saturated, dark: shares of that part at white, and too dark to tell stripes from noise.
    saturated: float = 0.0
    dark: float = 0.0
    contrast: float = 1.0  # how many times as bright as most of it its brightest percent is

    def describe(self, pair: str) -> str:
        """One line for a person."""
        words = [f"{pair}: exposure {self.exposure_ms:.1f} ms, {100 * self.lit:.0f} % is lit"]
        if self.saturated > MAX_SATURATED:
            words.append(f"{100 * self.saturated:.1f} % of that is saturated (a lamp, a mirror?)")
        if self.contrast > 1.7:  # white cloth reflects 0.9 of the light, skin 0.4 to 0.6
            words.append(f"some is {self.contrast:.1f} times as bright as most (a white shirt?)")
        if self.dark > 0.05:
            words.append(f"{100 * self.dark:.0f} % is too dark (dark hair, dark cloth?)")
        return "; ".join(words)


def measure_exposure(lit: Bytes, dark: Bytes, exposure_ms: float) -> tuple[Exposure, float]:
    """Judge a lit and a dark image (height, width); and the factor by which the exposure should
    change so that the brightest percent of what is lit comes to 85 % of white."""
    white = float(np.iinfo(lit.dtype).max)
    light = (lit.astype(np.float32) - dark) / white
    part = light > 0.01  # 2.5 of 255 levels: above the noise of any camera that can decode
    if not part.any():
        return Exposure(exposure_ms), 2.0
    bright = lit[part] / white
    saturated, top = float(np.mean(bright >= 0.99)), float(np.quantile(bright, 0.99))
    # A saturated image does not tell how far it is too bright: halve, and look again.
    factor = 0.5 if saturated > MAX_SATURATED else 0.85 / max(top, 0.05)
    weak = float(np.mean(light[part] < 0.02))  # five levels between lit and dark
    contrast = top / float(np.median(bright))
    return Exposure(exposure_ms, float(part.mean()), saturated, weak, contrast), factor


def find_exposures(devices: Devices) -> Iterator[tuple[str, Exposure]]:
    """Set each camera's exposure on what stands there now, by its pair's lit and dark frames.

    Cameras whose exposure cannot be set, or that have no lit and dark frame, are left as they are.
    Raises FailedWork for a camera that does not see its projector's light at all.
    """
    lit, dark = devices.rig.frames.lit, devices.rig.frames.dark
    for pair, projector in devices.projectors.items():
        camera = devices.cameras[pair]
        if camera.exposure_ms is None or lit is None or dark is None:
            continue
        found = _settle(camera, projector, lit, dark)
        if not found.lit:
            raise _make_unseen_light_error(devices, pair)
        yield pair, found


def _settle(camera: Camera, projector: Projector, lit: str, dark: str) -> Exposure:
    """Adjust a camera's exposure until the image is well exposed, in at most eight tries."""
    assert camera.exposure_ms is not None
    found = Exposure(camera.exposure_ms)
    camera.begin("exposure", [lit, dark] * 8)
    for _ in range(8):
        images = []
        for frame in (lit, dark):
            projector.show(frame)
            time.sleep((projector.delay_ms or 0.0) / 1000.0)
            images.append(_look(camera, frame).image)
        projector.rest()
        found, factor = measure_exposure(images[0], images[1], camera.exposure_ms)
        if found.lit and found.saturated <= MAX_SATURATED and 0.8 < factor < 1.25:
            break
        camera.expose(min(max(camera.exposure_ms * factor, 0.05), 200.0))
    return found


def measure_delays(devices: Devices) -> dict[str, float]:
    """Show black, then white, and measure how long after `show` each projector's light is on, ms.

    Only of projectors whose delay is not known yet. Raises FailedWork if a camera sees no change.
    """
    lit, dark = devices.rig.frames.lit, devices.rig.frames.dark
    measured = {}
    for pair, projector in devices.projectors.items():
        if projector.delay_ms is None and lit is not None and dark is not None:
            measured[pair] = projector.delay_ms = _shake_hands(devices, pair, lit, dark)
    return measured


def _shake_hands(devices: Devices, pair: str, lit: str, dark: str) -> float:
    camera, projector = devices.cameras[pair], devices.projectors[pair]
    projector.show(dark)
    time.sleep(0.3)  # longer than any display buffers
    black = float(_look(camera, dark).image.mean())
    shown_ms, seen = now_ms(), list[tuple[float, float]]()
    projector.show(lit)
    while now_ms() - shown_ms < 500.0:
        picture = _look(camera, lit)
        began_ms = picture.began_ms if picture.clock == HOST else picture.received_ms
        seen.append((began_ms - shown_ms, float(picture.image.mean())))
    projector.rest()
    white = seen[-1][1]
    if white - black < 1.0:
        raise _make_unseen_light_error(devices, pair)
    on_ms = next(at for at, level in seen if level > 0.9 * white + 0.1 * black)
    # Light may have come at any moment since the picture before.
    between_ms = float(np.median(np.diff([at for at, _ in seen]))) if len(seen) > 1 else 0.0
    return max(on_ms, 0.0) + between_ms


def _look(camera: Camera, frame: str) -> Picture:
    camera.trigger(frame)
    return camera.take(5.0)


def _make_unseen_light_error(devices: Devices, pair: str) -> FailedWork:
    return FailedWork(
        f"the camera of pair {pair} does not see its projector's light",
        where=f"rig {devices.rig.name}",
        remedy="Possible causes: cables, the display or the camera of another pair, a lens cap, "
        "nobody in front of the rig",
    )
