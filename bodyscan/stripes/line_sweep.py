"""A line of light swept over the scene, one image per stripe: s from when it comes and goes.

At a pixel with stripe coordinate s the light comes and goes over the images. The part of it that
comes in images i and later is, whatever the line's width and blur sigma,

    (1 + erf((s - i) / (sqrt(2) sigma))) / 2.

With z_i = (s - i) / sigma from the inverse of that, for the boundaries k and k + 1 on both sides of
the brightest image k, s = k + z_k / (z_k - z_(k+1)). Sigma drops out; a parabola through the
logarithms of three images would require a Gaussian line. If stripes are much wider than the blur,
that says little in their middle, and s comes from the boundaries on both sides.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from bodyscan.arrays import Floats, Greys
from bodyscan.stripes.pixel_stripes import pixel_stripe_map
from bodyscan.stripes.scan_lines import ScanLines
from bodyscan.stripes.sequence_checks import check_illumination
from bodyscan.stripes.stripe_map import StripeMap
from bodyscan.stripes.stripe_order import check_order
from bodyscan.stripes.usable_pixels import (
    MIN_CONTRAST,
    MIN_CONTRAST_TO_NOISE,
    SATURATED,
    beside_jumps,
    half_covered_pixels,
)

REACH = 3
"""Images before and after the brightest in which its light may be seen."""

SAMPLES = 15
MAX_SECOND = 0.3
"""Relative brightness of another peak; above it the light may have come by way of another surface,
or the pixel sees two."""

MAX_SHARE = 0.99
LEAST_SIGMA = 0.003
SIGMA_WITHIN = 12.0**-0.5
"""Standard deviation of s anywhere in a stripe."""

BANDS = 8
ENOUGH_PIXELS = 200


def decode_sweep(lit: Greys, frames: Greys, direction: str) -> StripeMap:
    """The stripe map.

    lit: (H, W).
    frames: (stripes, H, W), most of them dark at any one pixel.

    Raises DecodingFailed if the images are inconsistent.
    """
    stripes = len(frames)
    lines = ScanLines.along_lines(lit, lit, frames, None, direction)
    sweep = _Sweep.of(lines.patterns)
    base_noise2 = sweep.base_noise2(lines.patterns)
    rise = sweep.noise_rise(lines.lit, base_noise2)
    noise = np.sqrt(base_noise2 + rise * sweep.height)
    shown = sweep.height >= np.maximum(MIN_CONTRAST, MIN_CONTRAST_TO_NOISE * noise)
    check_illumination(shown, np.where(shown, sweep.height + sweep.base, 0))
    usable = shown & (sweep.height + sweep.base < SATURATED)
    check_order(sweep.peak, usable, lines.turned, stripes)
    usable &= sweep.second < np.maximum(MAX_SECOND * sweep.height, MIN_CONTRAST_TO_NOISE * noise)
    usable &= (sweep.peak > 0) & (sweep.peak < stripes - 1)
    usable &= ~half_covered_pixels(sweep.total, shown) & ~beside_jumps(sweep.peak, usable)
    s, sigma = sweep.coordinates(base_noise2, rise)
    s[~usable] = np.nan
    sigma[~usable] = np.nan
    grey = np.arange(256, dtype=np.float32)
    variance = base_noise2 + rise * np.maximum(grey - np.median(sweep.base), 0.0)
    whole = np.clip(sweep.total + sweep.base, 0, 255).astype(np.uint8)
    images = ScanLines(whole, sweep.base.astype(np.uint8), lines.patterns, None, lines.turned)
    variance = variance.astype(np.float32)
    return pixel_stripe_map(images, lit, s, sigma, variance, stripes, codes=sweep.peak)


class _Sweep:
    """What each pixel (L, P) saw of the sweep, grey levels.

    base: without the line.
    peak: number of the brightest image.
    window: (2 REACH + 1, L, P) the images around it, above the base.
    height: of the brightest image.
    total: of the whole window.
    second: the brightest of the other images.
    """

    def __init__(self, base: Floats, peak: NDArray[np.int32], window: Floats, second: Floats):
        self.base, self.peak, self.window, self.second = base, peak, window, second
        self.height, self.total = window[REACH], window.sum(axis=0)

    @staticmethod
    def of(frames: Greys) -> _Sweep:
        """From frames (F, L, P)."""
        base = np.median(frames[:: max(1, len(frames) // SAMPLES)], axis=0).astype(np.float32)
        peak = frames.argmax(axis=0).astype(np.int32)
        image = peak + np.arange(-REACH, REACH + 1)[:, None, None]
        inside = (image >= 0) & (image < len(frames))
        window = np.take_along_axis(frames, np.where(inside, image, 0), axis=0).astype(np.float32)
        second = np.zeros(base.shape, frames.dtype)
        for number, frame in enumerate(frames):
            np.maximum(second, np.where(np.abs(peak - number) > REACH, frame, 0), out=second)
        return _Sweep(base, peak, np.where(inside, window - base, np.float32(0.0)), second - base)

    def coordinates(self, base_noise2: float, rise: float) -> tuple[Floats, Floats]:
        """s and its standard deviation. rise: see `noise_rise`."""
        total = np.maximum(self.total, 1.0)
        z, dz = [], []
        for first in (REACH, REACH + 1):
            later, images = self.window[first:].sum(axis=0), len(self.window) - first
            part = np.clip(later / total, 1.0 - MAX_SHARE, MAX_SHARE)
            noise2 = (1.0 - part) ** 2 * (images * base_noise2 + rise * np.maximum(later, 0.0))
            noise2 += part**2 * (first * base_noise2 + rise * np.maximum(total - later, 0.0))
            z.append(ndtri(part))
            dz.append(np.sqrt(2.0 * np.pi * noise2) * np.exp(z[-1] ** 2 / 2.0) / total)
        width = np.maximum(z[0] - z[1], 1e-3)
        share = z[0] / width
        sigma = np.hypot((1.0 - share) * dz[0], share * dz[1]) / width
        # If all light is in one image, s is known to be in that stripe, and not where.
        sharp = np.minimum(z[0], -z[1]) > 0.999 * ndtri(MAX_SHARE)
        sigma = np.hypot(sigma, np.where(sharp, SIGMA_WITHIN, LEAST_SIGMA)).astype(np.float32)
        s = (self.peak + share).astype(np.float32)
        return s, sigma

    def base_noise2(self, frames: Greys) -> float:
        """Variance of an image away from the line."""
        every = max(1, len(frames) // SAMPLES)
        apart = [
            (frames[number].astype(np.float32) - self.base)[np.abs(self.peak - number) > REACH]
            for number in range(0, len(frames), every)
        ]
        stray = np.abs(np.concatenate(apart))
        # Grey levels are whole numbers, and so would be their median; the mean is not.
        return float(max(np.mean(np.minimum(stray, 8.0)) ** 2 * np.pi / 2.0, 0.15))

    def noise_rise(self, lit: Greys, base_noise2: float) -> float:
        """Increase of the variance with each grey level of light.

        The window adds up to what the lit image shows, except for the noise of both.
        """
        above = lit - self.base
        bright = (above > 20) & (lit < SATURATED) & (self.total > 20)
        if np.count_nonzero(bright) < ENOUGH_PIXELS:
            return 0.0
        above, total = above[bright], self.total[bright]
        share = np.median(total / above)
        stray = np.abs(total - share * above)
        order = np.array_split(np.argsort(above), BANDS)
        spread2 = np.array([np.median(stray[band]) / 0.6745 for band in order]) ** 2
        level = np.array([above[band].mean() for band in order])
        own = (2 * REACH + 1 + share**2) * base_noise2
        return float(np.clip(np.median((spread2 - own) / (share + share**2) / level), 0.0, 0.2))
