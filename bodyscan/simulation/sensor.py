"""From light to grey levels: the laser's speckle, the lens's blur and shade, the sensor's noise."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from bodyscan.arrays import Bytes, Floats
from bodyscan.simulation.lens import TrueCamera
from bodyscan.simulation.settings import Lighting, Noise, Optics

_FOCUS_STEPS = 5


def exposure(lit: Floats, grey: float, lighting: Lighting) -> float:
    """The exposure at which the brightest thousandth of a lit image begins at `grey`."""
    bright = max(float(np.percentile(lit, 99.9)), 1e-3)
    return float(np.clip(grey / bright, lighting.shortest, lighting.longest))


@dataclass(frozen=True, eq=False)
class FixedPattern:
    """What each pixel of a sensor does in every image. gain: (H, W), 1 on the mean.  grey: (H, W)."""

    gain: Floats
    grey: Floats


def fixed_pattern(
    camera: TrueCamera, noise: Noise, rng: np.random.Generator
) -> FixedPattern | None:
    """Of a camera's sensor; None for one whose pixels are all alike."""
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
    """What the sensor makes of a noiseless image: shot and read noise, its pixels' own, 8 bits."""
    if fixed is not None:
        image = image * fixed.gain + fixed.grey
    electrons = noise.electrons_per_grey * noise.photons
    spread = np.sqrt(np.maximum(image, 0.0) / electrons + noise.read_grey**2)
    noisy = image + spread * rng.standard_normal(image.shape, dtype=np.float32)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def add_speckle(image: Floats, size: float, rng: np.random.Generator) -> Floats:
    """Laser light with speckle of relative standard deviation `size` and mean 1: a gamma
    distribution, as that of speckle averaged over a pixel (Goodman, Speckle Phenomena, 2007)."""
    if size <= 0:
        return image
    return image * (
        rng.standard_gamma(size**-2, image.shape, dtype=np.float32) * np.float32(size**2)
    )


def shade(camera: TrueCamera, optics: Optics) -> Floats | float:
    """Vignetting: the share of light that arrives, (height, width)."""
    if optics.vignetting <= 0:
        return 1.0
    cosine = 1.0 / np.linalg.norm(camera.directions(camera.grid()), axis=-1)
    return (1.0 - optics.vignetting * (1.0 - cosine**4)).astype(np.float32)


def off_focus(depth: Floats, focus_mm: float) -> Floats:
    """How far out of focus depths (mm, > 0) are: |focus / depth - 1|, as the circle of confusion
    grows; 0 at focus_mm, 1 at half of it and at most."""
    return np.minimum(np.abs(np.float32(focus_mm) / depth - 1.0), 1.0)


def blur(image: Floats, optics: Optics, out_of_focus: Floats | None) -> Floats:
    """The lens's Gaussian blur; wider where the scene is out of focus (0..1), if that is given."""
    if optics.defocus_px <= 0 or out_of_focus is None:
        return _gaussian(image, optics.blur_px)
    place = out_of_focus * (_FOCUS_STEPS - 1)
    result = np.zeros_like(image)
    for step in range(_FOCUS_STEPS):
        share = np.maximum(1.0 - np.abs(place - step), 0.0).astype(np.float32)
        if not share.any():
            continue
        wide = np.hypot(optics.blur_px, optics.defocus_px * step / (_FOCUS_STEPS - 1))
        result += share * _gaussian(image, float(wide))
    return result


def _gaussian(image: Floats, sigma: float) -> Floats:
    if sigma <= 0:
        return image
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma, borderType=cv2.BORDER_REFLECT_101))
