"""Stripe sequences on surfaces with a known stripe coordinate, for the tests of this folder."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

SUPERSAMPLING = 5


@dataclass(frozen=True)
class Sequence:
    """Frames as `read_stripes` takes them, and the truth at pixel centres (NaN: no surface)."""

    lit: np.ndarray
    dark: np.ndarray
    patterns: np.ndarray
    inverses: np.ndarray
    s: np.ndarray


Field = Callable[[np.ndarray, np.ndarray], np.ndarray]


def white(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    return np.ones_like(u)


def checkered(size_px: float, black: float = 0.1, turned_deg: float = 20.0) -> Field:
    """Black and white squares, turned so that their edges cross the stripes at all angles."""
    cos, sin = np.cos(np.radians(turned_deg)), np.sin(np.radians(turned_deg))

    def albedo(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        column, row = (
            np.floor((cos * u - sin * v) / size_px),
            np.floor((sin * u + cos * v) / size_px),
        )
        return np.where((column + row) % 2 == 0, black, 1.0)

    return albedo


def render_sequence(
    s_at: Field,
    *,
    stripes: int,
    shape: tuple[int, int] = (200, 260),
    albedo: Field = white,
    light: float = 180.0,
    ambient: float = 15.0,
    lens_blur_px: float = 0.6,
    light_blur_stripes: float = 0.25,
    noise: float = 1.0,
    seed: int = 0,
) -> Sequence:
    """Frames of the surface on which s is `s_at(u, v)`; NaN, or beyond the stripes: dark."""
    n = SUPERSAMPLING
    height, width = shape
    u, v = np.meshgrid(
        (np.arange(width * n) + 0.5) / n - 0.5, (np.arange(height * n) + 0.5) / n - 0.5
    )
    s, brightness = s_at(u, v), albedo(u, v)
    on = np.isfinite(s) & (s >= 0) & (s < stripes)
    rng = np.random.default_rng(seed)

    def frame(lit_stripes: np.ndarray) -> np.ndarray:
        table = smeared(lit_stripes.astype(float), light_blur_stripes)
        share = np.where(on, table(np.where(on, s, 0.0)), 0.0)
        fine = (np.where(np.isfinite(s), ambient, 0.0) + light * share) * brightness
        image = cv2.GaussianBlur(fine, (0, 0), lens_blur_px * n)
        image = image.reshape(height, n, width, n).mean(axis=(1, 3))
        image = image + rng.normal(0.0, noise, image.shape)
        return np.clip(np.rint(image), 0, 255).astype(np.uint8)

    index = np.arange(stripes)
    bits = int(np.ceil(np.log2(stripes)))
    gray = index ^ (index >> 1)
    on_in = [(gray >> (bits - 1 - bit)) & 1 == 1 for bit in range(bits)]
    uc, vc = np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float))
    truth = s_at(uc, vc)
    return Sequence(
        lit=frame(np.ones(stripes)),
        dark=frame(np.zeros(stripes)),
        patterns=np.stack([frame(stripe_on) for stripe_on in on_in]),
        inverses=np.stack([frame(~stripe_on) for stripe_on in on_in]),
        s=np.where((truth >= 0) & (truth < stripes), truth, np.nan),
    )


def smeared(values: np.ndarray, blur: float) -> Callable[[np.ndarray], np.ndarray]:
    """Light against s: stripes smeared by a Gaussian of `blur` stripes; beyond the ends as there."""
    fine = 64
    padded = np.pad(values, 4, mode="edge").repeat(fine)
    if blur > 0:
        reach = int(4 * blur * fine) + 1
        kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / fine / blur) ** 2)
        padded = np.convolve(padded, kernel / kernel.sum(), mode="same")

    def light(s: np.ndarray) -> np.ndarray:
        return padded[np.clip(((s + 4) * fine).astype(int), 0, len(padded) - 1)]

    return light
