"""What varies from frame to frame: the projector's
brightness, the camera's gain, lamps on mains."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from bodyscan.simulation.settings import SimulationSettings


@dataclass(frozen=True)
class Brightness:
    """Relative brightness of one frame, 1 if nothing flickers."""

    laser: float = 1.0
    room: float = 1.0
    gain: float = 1.0


def draw_flicker(
    frames: Iterable[str], settings: SimulationSettings, rng: np.random.Generator
) -> Mapping[str, Brightness]:
    """Brightness by frame; the frames are in the order in which they are taken, at the person's
    pace.

    A lamp pulses; a frame sees its mean over the exposure, which is as long as the frame. None if
    nothing flickers.
    """
    light, pace = settings.lighting, settings.pace.frame_ms / 1000.0
    if not any((light.mains_depth, settings.projection.flicker, settings.noise.gain_flicker)):
        return {}
    seen = light.mains_depth * float(np.sinc(light.mains_hz * pace))
    start = rng.uniform(0.0, 2.0 * np.pi)
    return {
        frame: Brightness(
            1.0 + settings.projection.flicker * rng.standard_normal(),
            1.0 + seen * np.cos(start + 2.0 * np.pi * light.mains_hz * pace * place),
            1.0 + settings.noise.gain_flicker * rng.standard_normal(),
        )
        for place, frame in enumerate(frames)
    }
