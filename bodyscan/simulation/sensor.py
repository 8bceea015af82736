"""Lens blur and vignetting, flicker and speckle, and the sensor that makes grey levels of light."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from bodyscan.arrays import Bytes, Floats
from bodyscan.simulation.lens import TrueCamera
from bodyscan.simulation.settings import Lighting, Noise, Optics, SimulationSettings


@dataclass(frozen=True)
class Brightness:
    """Relative brightness of one frame, 1 if nothing flickers."""

    laser: float = 1.0
    room: float = 1.0
    gain: float = 1.0


def draw_flicker(
    frames: Iterable[str], settings: SimulationSettings, rng: np.random.Generator
) -> Mapping[str, Brightness]:
    """Draw the brightness of each frame, taken in this order at the person's pace.

    A lamp pulses; a frame sees its mean over the exposure, which is as long as the frame. None if
    nothing flickers.
    """
    light, pace = settings.lighting, settings.pace.frame_ms / 1000.0
    if not any((light.mains_depth, settings.projection.flicker, settings.noise.gain_flicker)):
        return {}
    depth = light.mains_depth * float(np.sinc(light.mains_hz * pace))
    start = rng.uniform(0.0, 2.0 * np.pi)
    return {
        frame: Brightness(
            1.0 + settings.projection.flicker * rng.standard_normal(),
            1.0 + depth * np.cos(start + 2.0 * np.pi * light.mains_hz * pace * level),
            1.0 + settings.noise.gain_flicker * rng.standard_normal(),
        )
        for level, frame in enumerate(frames)
    }


def choose_exposure(lit: Floats, grey: float, lighting: Lighting) -> float:
    """Choose the exposure at which the brightest thousandth of a lit image begins at `grey`."""
    bright = max(float(np.percentile(lit, 99.9)), 1e-3)
    return float(np.clip(grey / bright, lighting.shortest, lighting.longest))


@dataclass(frozen=True, eq=False)
class FixedPattern:
    """Errors of each pixel common to all images. gain: (H, W), mean 1. grey: (H, W)."""

    gain: Floats
    grey: Floats


def draw_fixed_pattern(
    camera: TrueCamera, noise: Noise, rng: np.random.Generator
) -> FixedPattern | None:
    """Draw a sensor's fixed pattern; None if all its pixels respond equally."""
    if noise.pixel_gain <= 0 and noise.pixel_grey <= 0:
        return None
    gain, grey = rng.standard_normal((2, camera.height, camera.width), dtype=np.float32)
    one = np.float32(1.0)
    return FixedPattern(
        one + np.float32(noise.pixel_gain) * gain, np.float32(noise.pixel_grey) * grey
    )


def expose(
    image: Floats, noise: Noise, rng: np.random.Generator, fixed: FixedPattern | None = None
) -> Bytes:
    """Expose an image to 8 bits: fixed pattern, shot and read noise."""
    if fixed is not None:
        image = image * fixed.gain + fixed.grey
    electrons = noise.electrons_per_grey * noise.photons
    sigma = np.sqrt(np.maximum(image, 0) / np.float32(electrons) + np.float32(noise.read_grey**2))
    noisy = image + sigma * rng.standard_normal(image.shape, dtype=np.float32)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def add_speckle(image: Floats, size: float, rng: np.random.Generator) -> Floats:
    """Multiply by laser speckle of mean 1 and sigma `size`: gamma-distributed (Goodman 2007)."""
    if size <= 0:
        return image
    return image * (
        rng.standard_gamma(size**-2, image.shape, dtype=np.float32) * np.float32(size**2)
    )


@lru_cache(maxsize=4)
def shade(camera: TrueCamera, optics: Optics) -> Floats | float:
    """Compute vignetting: the share of light that arrives, (height, width)."""
    if optics.vignetting <= 0:
        return 1.0
    cosine = 1.0 / np.linalg.norm(camera.directions(camera.grid()), axis=-1)
    return (1.0 - optics.vignetting * (1.0 - cosine**4)).astype(np.float32)


def defocus(depth: Floats, focus_mm: float) -> Floats:
    """Compute |focus / depth - 1| of depths (mm, > 0), at most 1, which is half the distance."""
    return np.minimum(np.abs(np.float32(focus_mm) / depth - 1.0), 1.0)


def list_blurs(optics: Optics, out_of_focus: Floats) -> list[tuple[float, Floats | None]]:
    """List Gaussian blurs, px, wider out of focus, and each one's share (H, W) (None: all)."""
    if optics.defocus_px <= 0:
        return [(optics.blur_px, None)]
    steps = 5
    level = out_of_focus * (steps - 1)
    blurs: list[tuple[float, Floats | None]] = []
    for step in range(steps):
        share = np.maximum(1.0 - np.abs(level - step), 0.0).astype(np.float32)
        wide = np.hypot(optics.blur_px, optics.defocus_px * step / (steps - 1))
        if share.any():
            blurs.append((float(wide), share))
    return blurs


def blur(image: Floats, blurs: Sequence[tuple[float, Floats | None]]) -> Floats:
    """Blur an image (H, W) as the lens does."""
    result = np.zeros_like(image)
    for wide, share in blurs:
        if share is None:
            return _blur_gaussian(image, wide)
        result += share * _blur_gaussian(image, wide)
    return result


def _blur_gaussian(image: Floats, sigma: float) -> Floats:
    if sigma <= 0:
        return image
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma, borderType=cv2.BORDER_REFLECT_101))
