"""Stripes decoded from patterns of bits: Gray or plain binary code, with or without inverses."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bodyscan.arrays import Floats, Greys
from bodyscan.errors import DecodingFailed
from bodyscan.stripes.albedo_edges import Brightness, without_edges_across
from bodyscan.stripes.bit_words import WordCode
from bodyscan.stripes.boundaries import find_boundaries
from bodyscan.stripes.boundary_scatter import local_scatter, scatter
from bodyscan.stripes.code_lines import fill_from_codes
from bodyscan.stripes.grey_noise import noise_variance
from bodyscan.stripes.line_bands import LineBands
from bodyscan.stripes.scan_lines import ScanLines
from bodyscan.stripes.sequence_checks import check_codes, check_exposure
from bodyscan.stripes.stripe_coordinates import alike_along_lines, interpolate_stripes
from bodyscan.stripes.stripe_limits import StripeLimits
from bodyscan.stripes.stripe_map import StripeMap, boundary_map, stripe_map
from bodyscan.stripes.usable_pixels import MIN_CONTRAST, shown_pixels

SAMPLES = 20_000
COARSE_BITS = 3
"""Finer patterns may be blurred; non-linear grey levels then brighten both pattern and inverse."""
NOISE_GREY, MAX_OFF = 8, 0.25
"""Grey levels by which noise may make two frames differ, and the share of the contrast beyond which
they were not exposed alike: boundaries would move by that share of their blur, a tenth of a
pixel."""


def decode_bits(
    code: WordCode,
    images: ScanLines,
    lit: Greys,
    stripes: int,
    limits: StripeLimits | None,
) -> StripeMap:
    """The stripe map from `bit_lines`.

    lit: (H, W) in the camera's layout.

    Raises DecodingFailed if the images are inconsistent.
    """
    variance = noise_variance(images)
    codes = code.stripes(read_words(code, images, stripes, variance))
    fine_bit = code.two_wide(len(images.patterns))
    usable, shown = shown_pixels(images, codes, variance, stripes, fine_bit)
    beyond = None
    if limits is not None:
        usable, beyond = limits.split(codes, usable, turned=images.turned)
        shown, _ = limits.split(codes, shown, turned=images.turned)
    brightness = Brightness.of(images, variance, usable)
    if images.bands is not None:
        usable = usable & images.bands.wanted[:, None]
    boundaries = find_boundaries(
        images, brightness, codes, usable, variance, code.finest_run, code.first
    )
    sigma_px = np.hypot(boundaries.sigma_px, code.doubt_px)
    boundaries = replace(boundaries, sigma_px=sigma_px)
    boundaries = replace(boundaries, sigma_px=scatter(boundaries) * boundaries.sigma_px)
    if images.bands is not None:
        return boundary_map(images, lit, boundaries, stripes)
    rough = None
    if images.lit.dtype != np.uint8:  # noise in whole levels hides relief, and is known less well
        ratio = local_scatter(boundaries)
        boundaries = replace(boundaries, sigma_px=ratio * boundaries.sigma_px)
        rough = ratio > 1.0
    s, sigma = interpolate_stripes(boundaries, codes, usable, rough)
    if code.single:  # in other codes words at boundaries may be wrong by any number
        fill_from_codes(s, sigma, codes, shown)
    s, sigma = without_edges_across(s, sigma, brightness, boundaries.blur2)
    found = stripe_map(images, lit, s, sigma, boundaries, stripes, beyond)
    along = alike_along_lines(boundaries)
    alike_px = (0.0, along) if images.turned else (along, 0.0)
    return replace(found, alike_px=alike_px)


def bit_lines(
    lit: Greys,
    dark: Greys | None,
    patterns: Greys,
    inverses: Greys | None,
    direction: str,
    bands: LineBands | None = None,
) -> ScanLines:
    """Lay out patterns (bits, H, W), and inverses if any, as scan lines, or only those near
    `bands`.

    A missing dark frame is made from the patterns and their inverses: every stripe is dark in one
    of each two. So are both lit and dark if they were exposed differently. Raises DecodingFailed if
    there are no inverses either.
    """
    turned, chosen = direction == "horizontal", None
    if bands is not None:
        chosen = bands.lines(lit.shape[1 if turned else 0], turned=turned)
        lit, patterns = (chosen.cut(images, turned=turned) for images in (lit, patterns))
        dark, inverses = (
            None if images is None else chosen.cut(images, turned=turned)
            for images in (dark, inverses)
        )
    if dark is None:
        if inverses is None:
            raise DecodingFailed(
                "neither a dark frame nor inverse patterns show what black is",
                remedy="take a dark frame",
            )
        dark = np.minimum(patterns, inverses).min(axis=0)
    if inverses is not None and not _exposed_alike(lit, dark, patterns, inverses):
        lit = np.maximum(patterns, inverses).max(axis=0)
        dark = np.minimum(patterns, inverses).min(axis=0)
    lines = ScanLines.along_lines(lit, dark, patterns, inverses, direction)
    return replace(lines, bands=chosen)


def _exposed_alike(lit: Greys, dark: Greys, patterns: Greys, inverses: Greys) -> bool:
    """Whether the brighter of a coarse pattern and its inverse is as bright as the lit frame, and
    the darker as dark as the dark one; a camera with automatic exposure makes them differ."""
    step = max(1, math.isqrt(lit.size // SAMPLES))
    some = (slice(None, None, step), slice(None, None, step))
    light, black = lit[some].astype(np.float32), dark[some].astype(np.float32)
    contrast = light - black
    shown = contrast >= MIN_CONTRAST
    if not shown.any():
        return True
    shown &= contrast >= np.median(contrast[shown])
    errors = []
    for bit in range(min(COARSE_BITS, len(patterns))):
        one, other = patterns[bit][some][shown], inverses[bit][some][shown]
        off = np.abs(np.maximum(one, other) - light[shown])
        off += np.abs(np.minimum(one, other) - black[shown])
        errors.append(float(np.mean(np.maximum(off - NOISE_GREY, 0.0) / contrast[shown])))
    return min(errors) < MAX_OFF


def read_words(
    code: WordCode, images: ScanLines, count: int, variance: Floats
) -> NDArray[np.uint16]:
    """Code words (L, P), of which there are `count`.

    variance: (256,) of each grey level.

    Raises DecodingFailed if the frames are inconsistent.
    """
    check_exposure(images)
    words = images.words()
    check_codes(images, words, code, count, variance)
    return words
