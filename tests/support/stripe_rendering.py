"""Stripe sequences on surfaces with a known stripe coordinate, for the tests of this folder."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np

from bodyscan.geometry.light_planes import Axis
from bodyscan.stripes.codes.gray import Gray
from bodyscan.stripes.decoding import decode_stripes
from bodyscan.stripes.stripe_map import StripeMap

SUPERSAMPLING = 5


@dataclass(frozen=True)
class Sequence:
    """Frames of a Gray code with inverses, and the truth at pixel centres (NaN: no surface)."""

    lit: np.ndarray
    dark: np.ndarray
    patterns: np.ndarray
    inverses: np.ndarray
    s: np.ndarray

    def decode(self, stripes: int) -> StripeMap:
        frames = self.lit, self.dark, self.patterns, self.inverses
        return decode_gray(*frames, stripes=stripes, direction="horizontal")


Field = Callable[[np.ndarray, np.ndarray], np.ndarray]


def wavy(stripe_px: float, *, slant: float = 0.1) -> Field:
    """A smooth, uneven field of s with stripes about `stripe_px` wide."""

    def s_at(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        return 3.3 + (v + slant * u + 2.5 * np.sin(u / 23) + 1.5 * np.sin(v / 31)) / stripe_px

    return s_at


def boundary_errors(seen: StripeMap, s_at: Field) -> np.ndarray:
    """How far boundaries lie from where they should be, across the stripes, px."""
    u, v = seen.boundary_pixels.T
    slope = s_at(u, v + 0.5) - s_at(u, v - 0.5)
    return (s_at(u, v) - seen.boundary_index) / slope


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


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


def render_sequence(s_at: Field, *, stripes: int, **scene: Any) -> Sequence:
    """Gray code with inverses on the surface on which s is `s_at(u, v)`; see `render`."""
    bits = gray_bits(np.arange(stripes))
    lit, dark, coded, s = render(s_at, np.concatenate([bits, 1 - bits]), stripes=stripes, **scene)
    patterns, inverses = np.split(coded, 2)
    return Sequence(lit, dark, patterns, inverses, s)


def decode_gray(
    lit: np.ndarray,
    dark: np.ndarray | None,
    patterns: np.ndarray,
    inverses: np.ndarray,
    *,
    stripes: int,
    direction: Axis,
) -> StripeMap:
    """`decode_stripes` of a Gray code with inverses. patterns, inverses: (bits, H, W)."""
    code = Gray.model_validate({"stripes": stripes, "direction": direction})
    return decode_stripes(code, lit, dark, np.concatenate([patterns, inverses]))


def gray_bits(words: np.ndarray) -> np.ndarray:
    """(bits, N): the reflected binary code of words that count up to the last."""
    bits = int(np.ceil(np.log2(words.max() + 1)))
    return (words ^ (words >> 1)) >> np.arange(bits)[::-1, None] & 1


def code_light(
    code: str,
    stripes: int,
    *,
    inverses: bool = True,
    steps: int | tuple[int, ...] = 4,
    period: float | tuple[float, ...] = 8,
    backward: bool = False,
    start_deg: float = 0.0,
    origin: float = 0.0,
) -> np.ndarray:
    """(images, 16 stripes): light of each image of a code, sixteen values a stripe."""
    s = (np.arange(16 * stripes) + 0.5) / 16
    if code == "light-section":
        return (np.floor(s) == np.arange(stripes)[:, None]).astype(float)
    parts: list[np.ndarray] = []
    periods = period if isinstance(period, tuple) else (period,)
    if code == "binary":
        bits = np.floor(s).astype(int) >> np.arange((stripes - 1).bit_length())[::-1, None] & 1
        parts = [bits, 1 - bits]
    elif code == "gray" or len(periods) == 1:
        bits = gray_bits(np.floor(s if code == "gray" else 2 * s / periods[0]).astype(int))
        parts = [bits, 1 - bits]
    parts = parts if inverses else parts[:1]
    if code == "phase-shift":
        counts = steps if isinstance(steps, tuple) else (steps,) * len(periods)
        for length, count in zip(periods, counts, strict=True):
            shift = np.arange(count)[:, None] / count * (-1 if backward else 1)
            turns = (s - origin) / length - shift + start_deg / 360
            parts.append(0.5 + 0.5 * np.cos(2 * np.pi * turns))
    return np.concatenate(parts).astype(float)


def render(
    s_at: Field,
    lights: np.ndarray,
    *,
    stripes: int,
    shape: tuple[int, int] = (200, 260),
    albedo: Field = white,
    light: float = 180.0,
    ambient: float = 15.0,
    noise: float = 1.0,
    seed: int = 0,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Lit, dark and coded frames of a surface on which s is `s_at(u, v)`, and s at pixel centres. Where
    s is NaN, or beyond the stripes, it is dark. lights: (images, k stripes), the light of each image at
    evenly spaced s."""
    n = SUPERSAMPLING
    height, width = shape
    s, truth = _fine_and_at_pixels(s_at, shape)
    brightness = albedo(*_fine_places(shape))
    on = np.isfinite(s) & (s >= 0) & (s < stripes)
    rng = np.random.default_rng(seed)
    background = (np.where(np.isfinite(s), ambient, 0.0) * brightness).astype(np.float32)
    lit_share = np.where(on, light * brightness, 0.0).astype(np.float32)
    place = places_in_table(np.where(on, s, 0.0), stripes)

    def frame(values: np.ndarray) -> np.ndarray:
        table = smeared(values.astype(float), 0.25, len(values) // stripes)
        fine = table.astype(np.float32).take(place)
        fine *= lit_share
        fine += background
        blurred = cv2.GaussianBlur(fine, (0, 0), 0.6 * n)
        image = cv2.resize(blurred, (width, height), interpolation=cv2.INTER_AREA)
        image = image + rng.normal(0.0, noise, image.shape)
        return np.clip(np.rint(image), 0, 255).astype(np.uint8)

    return (
        frame(np.ones(stripes)),
        frame(np.zeros(stripes)),
        np.stack([frame(values) for values in lights]),
        np.where((truth >= 0) & (truth < stripes), truth, np.nan),
    )


@lru_cache(2)
def _fine_and_at_pixels(s_at: Field, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """s at the samples of a picture (H, W), and at its pixels' centres; kept for the next picture."""
    height, width = shape
    centres = np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float))
    return s_at(*_fine_places(shape)), s_at(*centres)


def _fine_places(shape: tuple[int, int]) -> tuple[np.ndarray, ...]:
    """u and v of the samples of a picture (H, W)."""
    n, (height, width) = SUPERSAMPLING, shape
    return np.meshgrid(
        (np.arange(width * n) + 0.5) / n - 0.5, (np.arange(height * n) + 0.5) / n - 0.5
    )


TABLE_PER_STRIPE, TABLE_AHEAD = 64, 4


def smeared(values: np.ndarray, blur: float, parts: int = 1) -> np.ndarray:
    """Table of the light against s, smeared by a Gaussian of `blur` stripes; beyond the ends as there.

    values: of each stripe, or of each of its `parts`.
    """
    fine = TABLE_PER_STRIPE
    table = np.pad(values, TABLE_AHEAD * parts, mode="edge").repeat(fine // parts)
    if blur > 0:
        reach = int(4 * blur * fine) + 1
        kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / fine / blur) ** 2)
        table = np.convolve(table, kernel / kernel.sum(), mode="same")
    return table


def places_in_table(s: np.ndarray, stripes: int) -> np.ndarray:
    """Where values of s stand in the table that `smeared` makes of so many stripes."""
    last = (stripes + 2 * TABLE_AHEAD) * TABLE_PER_STRIPE - 1
    place = ((s + TABLE_AHEAD) * TABLE_PER_STRIPE).astype(np.intp)  # as numpy looks things up
    return np.asarray(np.clip(place, 0, last))
