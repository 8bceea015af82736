"""Waves of light, shifted by a part of their period from image to image: their phase at each pixel.

Image k of N shows 1/2 + 1/2 cos(phi - 2 pi k / N), so that, whatever the surface's brightness,

    phi = atan2(sum I_k sin(2 pi k / N), sum I_k cos(2 pi k / N)).

Source: Creath, Phase-measurement interferometry techniques, Progress in Optics 26 (1988).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodyscan.arrays import Floats, Greys
from bodyscan.stripes.wave import Wave

LEAST_SIGMA = 5e-4
"""Of a period: what light that is not quite a wave, and rounding, leave."""


@dataclass(frozen=True, eq=False)
class WaveSeen:
    """One wave as the pixels (L, P) saw it.

    turn: s / period less a whole number, 0 to 1.  amplitude, mean: grey levels, at least 1e-3.
    """

    wave: Wave
    turn: Floats
    amplitude: Floats
    mean: Floats

    def sigma(self, noise: Floats) -> Floats:
        """Standard deviation (L, P) of `turn`; noise: of one image's grey levels."""
        by_noise = noise / (self.amplitude * np.float32(np.pi * np.sqrt(2.0 * self.wave.steps)))
        return np.hypot(by_noise, np.float32(LEAST_SIGMA))


def see_wave(images: Greys, wave: Wave) -> WaveSeen:
    """From its images (steps, L, P)."""
    angle = 2.0 * np.pi * np.arange(len(images)) / len(images)
    if wave.shift == "backward":
        angle = -angle
    sine, cosine, mean = (
        np.einsum("nlp,n->lp", images, weight.astype(np.float32))
        for weight in (np.sin(angle), np.cos(angle), np.full(len(images), 1.0 / len(images)))
    )
    amplitude = np.hypot(sine, cosine) * np.float32(2.0 / len(images))
    turn = np.arctan2(sine, cosine) / np.float32(2.0 * np.pi) + np.float32(wave.first_turn)
    floor = np.float32(1e-3)
    return WaveSeen(wave, turn % np.float32(1.0), np.maximum(amplitude, floor), mean)


def split_waves(images: Greys, waves: tuple[Wave, ...]) -> list[Greys]:
    """The images (F, L, P) of each wave, which follow each other."""
    return np.split(images, np.cumsum([wave.steps for wave in waves])[:-1])
