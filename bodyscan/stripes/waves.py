"""Waves of light, shifted by a part of their period from image to image: their phase at each pixel.

Image k of N shows 1/2 + 1/2 cos(phi - 2 pi k / N), so that, whatever the surface's brightness,

    phi = atan2(sum I_k sin(2 pi k / N), sum I_k cos(2 pi k / N)).

Source: Creath, Phase-measurement interferometry techniques, Progress in Optics 26 (1988).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from bodyscan.arrays import Floats, Greys
from bodyscan.stripes.wave import Wave

LEAST_SIGMA = 5e-4
"""Share of a period: left by rounding and by light that is not quite a wave."""


@dataclass(frozen=True, eq=False)
class WaveSeen:
    """One wave as the pixels (L, P) saw it.

    turn: s / period modulo 1.
    amplitude, mean: grey levels, at least 1e-3.
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
    """Measure a wave from its images (steps, L, P)."""
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


def white_and_black(waves: Sequence[WaveSeen]) -> tuple[Floats, Floats]:
    """What the pixels would show under all of the projector's light, and under none of it."""
    white = np.mean([wave.mean + wave.amplitude for wave in waves], axis=0)
    black = np.mean([wave.mean - wave.amplitude for wave in waves], axis=0)
    return np.minimum(white, 255.0), np.maximum(black, 0.0)


def white_image(images: Greys, waves: tuple[Wave, ...]) -> Greys:
    """The scene under all of the projector's light, (H, W), from the images (F, H, W) of waves."""
    parts = zip(split_waves(images, waves), waves, strict=True)
    return in_type(white_and_black([see_wave(part, wave) for part, wave in parts])[0], images)


def in_type(grey: Floats, images: Greys) -> Greys:
    """Grey levels in the type of the images."""
    return np.rint(grey).astype(np.uint8) if images.dtype == np.uint8 else grey


def split_waves(images: Greys, waves: tuple[Wave, ...]) -> list[Greys]:
    """The images (F, L, P) of each wave; those of different waves follow each other."""
    ends = np.cumsum([0, *(wave.steps for wave in waves)])
    return [images[first:end] for first, end in pairwise(ends)]
